"""The control clock: causal holds, frames, routes and episodes."""

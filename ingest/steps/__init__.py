"""The control clock: causal holds, frames, cameras, routes and episodes."""

"""A fleet's questions: what drifted, what differs between two stores or panels, what to log."""

"""Beyond the paper: what several frames of both objects, or all objects of a category, tell
together."""

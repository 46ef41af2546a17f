"""A challenge for a class: objects that nobody has seen, and a ranking of hand-ins."""

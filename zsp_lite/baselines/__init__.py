"""Other methods, in the same pipeline or beside it."""

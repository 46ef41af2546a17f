"""Objects of one's own, from files to files: the pose between two of them, or of a whole
category."""

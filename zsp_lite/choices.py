"""Names that a user chooses from. The command line offers them without importing what they stand for."""

# Solvers of a pair, each with those that it runs.
SOLVERS = {"paper": ("paper",), "verified": ("verified",), "both": ("paper", "verified")}
# Where object masks come from: with the frames, GrabCut from a box, or depth.
MASKS = ("given", "box", "auto")

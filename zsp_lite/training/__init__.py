"""Training the embedded backbone on renders of the training categories."""

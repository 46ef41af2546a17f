"""Other methods: the baselines of the paper (ICP, SIFT, SwAV, PoseContrast), and RootSIFT features."""

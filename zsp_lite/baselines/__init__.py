"""Other methods: the baselines of the paper (ICP, SIFT), and RootSIFT features."""

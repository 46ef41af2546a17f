"""Training of small transformers from random weights on rendered objects, as notebook 09
shows it."""

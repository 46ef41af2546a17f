"""The course on the method: demo, sample data, renderer of synthetic objects, labelling, training
and widgets."""

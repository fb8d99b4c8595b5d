"""From what a method finds to its answer: which mirror image, where in space, how sure, and what seems wrong."""

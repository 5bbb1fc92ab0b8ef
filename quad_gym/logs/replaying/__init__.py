"""A filter on a log: the replay, its results, and the verdict on them."""

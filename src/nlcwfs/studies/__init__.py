"""Questions, many runs, one stamped table, one figure; and the pictures that answer them."""

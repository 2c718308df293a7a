"""Tables and figures of comparisons."""

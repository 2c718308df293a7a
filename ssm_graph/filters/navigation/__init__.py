"""The filters of the literature on the error state of a mission."""

"""Progress and the status page."""

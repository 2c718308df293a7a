"""A run on the vehicle: loop, folder, status."""

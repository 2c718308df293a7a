"""What is in a file, folder, bag or mission, and whether it can be smoothed."""

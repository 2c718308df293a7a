"""The filter to the letter: strapdown mechanisation in geodetic coordinates."""

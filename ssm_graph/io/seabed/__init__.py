"""Maps of the seabed in the formats that surveys and data centres give."""

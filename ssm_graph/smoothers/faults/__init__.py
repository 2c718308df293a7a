"""The search for what was off, and when: hypotheses that compete over stretches of a mission."""

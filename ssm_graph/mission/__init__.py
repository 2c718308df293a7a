"""Missions, vehicles and answers as values; keyframes, start and the estimation problem."""

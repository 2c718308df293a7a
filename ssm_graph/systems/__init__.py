"""What else the house can do: one package a system, none of which imports another.

A system is a problem of localisation of its own (landmarks, a road map, a network of nodes, a
camera with ranges). It takes factors, weights, filter laws, statistics and tables from the house.
"""

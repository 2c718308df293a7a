"""Guaranteed bounds: a network of nodes, a fleet, and one vehicle's integrity, by sets of states.

Start with :func:`.world.run_sets`, :func:`.integrity.check_integrity` or :func:`.fleet.run_fleet`;
docs/network.md says what is promised and what is not.
"""

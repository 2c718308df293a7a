"""Elimination of chains, error states, kernels' schedules: it knows no water and no instrument."""

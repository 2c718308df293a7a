"""Teledyne RD Instruments: PD0 ensembles."""

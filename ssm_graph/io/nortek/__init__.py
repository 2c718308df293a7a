"""Nortek: AD2CP files of DVLs and ADCPs with bottom track, and the packets of a Nucleus."""

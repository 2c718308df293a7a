"""Results in the formats that other software reads; one file for every kin of formats."""

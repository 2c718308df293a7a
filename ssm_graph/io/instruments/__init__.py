"""What makers publish of inertial units and DVLs, by name."""

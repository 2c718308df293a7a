"""From raw samples to preintegrated inertial measurements."""

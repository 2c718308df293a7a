"""ArduPilot: dataflash logs (.BIN) and telemetry logs (.tlog)."""

"""The command line: ``ssm-graph simulate | smooth | convert``."""

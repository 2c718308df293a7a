"""The command line: ``ssm-graph simulate | smooth | convert``."""

from ssm_graph.cli.main import main

__all__ = ["main"]

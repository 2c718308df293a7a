"""``python -m ssm_graph``: the same as ``ssm-graph``."""

import sys

from ssm_graph.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

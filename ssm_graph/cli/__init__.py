"""The command line.

``ssm-graph simulate | smooth | filter | online | compare | convert | export | report``.
"""

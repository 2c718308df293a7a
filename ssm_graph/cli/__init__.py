"""The command line.

``ssm-graph simulate | smooth | filter | online | compare | inspect | convert | export | report``.
"""

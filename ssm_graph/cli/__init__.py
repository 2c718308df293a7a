"""The command line.

``ssm-graph simulate | smooth | filter | online | compare | inspect | template | convert | export | report |
locate | locate-simulate | locate-study | slam | slam-study | integrity | network | network-run``.
"""

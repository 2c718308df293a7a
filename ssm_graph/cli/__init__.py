"""The command line.

``ssm-graph simulate | smooth | filter | online | compare | inspect | instruments | template |
convert | export | report | locate | locate-simulate | locate-study | slam | slam-study | visual |
visual-simulate | integrity | network | network-run``.
"""

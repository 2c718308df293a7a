"""The command line.

``ssm-graph simulate | smooth | filter | online | compare | inspect | instruments | template |
convert | export | report | locate | locate-simulate | locate-study | slam | slam-study | integrity
| network | network-run``.
"""

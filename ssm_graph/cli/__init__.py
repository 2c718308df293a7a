"""The command line.

``ssm-graph inspect | template | convert | instruments | simulate | smooth | filter | online |
report | export | compare | integrity | slam | slam-study | locate | locate-convert |
locate-simulate | locate-study | seabed | seabed-simulate | network | network-run | visual |
visual-simulate | help | completion``.
"""

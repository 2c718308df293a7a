"""Metric visual SLAM: one camera, and ranges to anchors at unknown places, tightly coupled.

docs/visual-ranges.md has the equations; the package needs ``pip install 'ssm-graph[visual]'``.
"""

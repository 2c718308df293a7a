"""``ssm-graph visual``: metric path, map and anchors from a camera and ranges."""

DESCRIPTION = ""

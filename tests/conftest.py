"""What holds for all tests."""

from hypothesis import settings

# No test judges how long something takes: a busy machine is no defect.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")

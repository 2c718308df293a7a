"""What holds for all tests."""

import signal

from hypothesis import settings

# A shell that starts the tests behind itself, or `nohup`, has their processes ignore these two;
# the tests send them.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# No test judges how long something takes: a busy machine is no defect.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")

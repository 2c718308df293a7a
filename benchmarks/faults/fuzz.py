"""Damaged traffic and damaged recordings: nothing may raise, grow, or let a bad number through.

``python -m benchmarks.faults.fuzz --keep`` (some ten minutes, most of them for recordings); a quick
look is ``--bytes 200000``.
Exit code 1 if anything failed.
"""

from __future__ import annotations

import random
import resource
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.report import Option, Report, note, table
from tests.damaged_files import FileTarget, file_targets
from tests.damaged_files import run as read_damaged
from tests.damaged_traffic import Target, run, targets

MAX_GROWTH_MB = 32.0


def peak_mb() -> float:
    """Return the largest resident size of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def file_lines(found: Sequence[FileTarget]) -> list[str]:
    """Return the table of recordings."""
    header = ["recording", "bytes", "files", "refused", "rows of the others", "time, s"]
    header += ["slowest file, s", "failures"]
    rows = [
        [t.name]
        + [f"{n:,}" for n in (t.fed, t.files, t.refused, t.rows)]
        + [f"{t.wall_s:.1f}", f"{t.slowest_s:.2f}", str(len(t.failures))]
        for t in found
    ]
    failures = [f"- {text}" for t in found for text in t.failures]
    return ["", FILES_LEGEND, *table(header, rows), "", *failures]


def report_lines(found: Sequence[Target], growth_mb: float) -> list[str]:
    """Return the table and the verdict."""
    header = ["decoder", "bytes", "chunks", "messages", "refusals taken", "most held, B", "time, s"]
    header += ["MB/s", "slowest chunk, ms", "failures"]
    rows = [
        [t.name]
        + [f"{n:,}" for n in (t.fed, t.chunks, t.messages, t.refusals, t.most_held)]
        + [f"{t.wall_s:.1f}", f"{t.fed / 1e6 / max(t.wall_s, 1e-9):.1f}"]
        + [f"{1e3 * t.slowest_s:.1f}", str(len(t.failures))]
        for t in found
    ]
    lines = [*table(header, rows), "", f"Resident size grew by {growth_mb:.1f} MB."]
    failures = [text for t in found for text in t.failures]
    if growth_mb > MAX_GROWTH_MB:
        failures.append(f"memory: grew by {growth_mb:.1f} MB, expected at most {MAX_GROWTH_MB:g}")
    verdict = "No failure." if not failures else f"{len(failures)} FAILURES:"
    return [*lines, "", f"**{verdict}**", "", *(f"- {text}" for text in failures)]


LEGEND = """\
Every decoder is fed its own traffic, one part in twenty of it another's, in blocks of 8 kB with up
to a dozen injuries each: bits flipped, bytes lost, pieces repeated elsewhere, noise, literals that
parsers fall over, other numbers, runs of 70 000 equal bytes, ends cut off; in chunks of 1 to 4096
bytes, one in a thousand with no sensible time of arrival. Checked after every chunk: nothing
raised, the bytes held are at most 64 KiB and a token, every message has finite numbers
(`bad_number`). After every fifth: at most 21 refusals, each printable and short. After every block:
the next sound message on a line of its own is decoded. Time is that inside `feed`. Resident size is
counted from the end of a first run of 5 % of the bytes.
"""
FILES_LEGEND = """\
## Recordings

What `ssm-graph convert` reads, as files of some 30 to 100 kB, half of them with up to a dozen
injuries as above, half with one to four bytes altered. Checked of each: it is refused with a
sentence, or all times increase and all numbers of its rows are finite; nothing else is raised.
"""


def main() -> int:
    """Run all decoders; return 1 if anything failed."""
    report = Report(
        *(__file__, "Damaged traffic", __doc__),
        Option("--bytes", 10_000_000, "to each decoder"),
        Option("--seed", 0, "of the damage"),
        Option("--only", "", "part of the names of those that are run"),
    )
    n_bytes, seed, only = report.args.bytes, report.args.seed, report.args.only.lower()
    warm = targets()
    for target in (one for one in warm if only in one.name):
        run(target, warm, n_bytes // 20, random.Random(-1 - seed))
    before_mb = peak_mb()
    found = targets()
    for k, target in enumerate(found):
        if only not in target.name:
            continue
        note(f"{target.name} ...")
        run(target, found, n_bytes, random.Random(1000 * seed + k))
    growth_mb = peak_mb() - before_mb
    with tempfile.TemporaryDirectory() as folder:
        files = file_targets(Path(folder))
        for k, recording in enumerate(files):
            if only not in recording.name.lower():
                continue
            note(f"{recording.name} ...")
            read_damaged(recording, Path(folder), n_bytes, random.Random(1000 * seed + k))
    done = [t for t in found if t.fed], [t for t in files if t.fed]
    report.write([LEGEND, *report_lines(done[0], growth_mb), *file_lines(done[1])])
    failed = any(t.failures for t in (*warm, *found)) or any(t.failures for t in files)
    return int(growth_mb > MAX_GROWTH_MB or failed)


if __name__ == "__main__":
    raise SystemExit(main())

"""What the command line says of itself, how quiet it can be, and what shells are told."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from ssm_graph.cli.main import COMMANDS, GROUPS, ExitCode, build_parser, command_parser, main
from ssm_graph.io.mission_folder.folder import write_mission
from ssm_graph.report.clock import clocked
from ssm_graph.report.mission.figure import MARKS_ACROSS, _apart
from ssm_graph.simulation import scenario_config, simulate


def test_help_names_every_command_once(capsys: pytest.CaptureFixture[str]) -> None:
    """By groups; exit codes stand in one place, which every help names."""
    grouped = [name for names in GROUPS.values() for name in names]
    assert len(grouped) == len(set(grouped))
    assert set(grouped) <= set(COMMANDS)
    text = build_parser(()).format_help()
    for name, summary in COMMANDS.items():
        assert f"  {name:16} {summary}\n" in text, name
    assert "ssm-graph help codes" in text
    assert main(["help", "codes"]) == 0
    codes = capsys.readouterr().out
    for code in ExitCode:
        assert f"\n  {code.value:<4} " in codes, code
    assert main(["help", "smooth"]) == 0
    assert "--find-faults" in capsys.readouterr().out
    assert main(["help", "methods"]) == 0
    own, others = capsys.readouterr().out.split("of compare alone:")
    assert "\n  ssm-log[:5] " in own
    assert "\n  oracle " in others
    assert main(["help", "smoth"]) == ExitCode.USAGE
    assert "did you mean 'smooth'" in capsys.readouterr().err


def test_an_option_and_a_word_have_values_of_their_own() -> None:
    """One of the same name would be taken for the other."""
    for name in COMMANDS:
        actions = command_parser(name)._actions
        words = {action.dest for action in actions if not action.option_strings}
        assert words.isdisjoint(action.dest for action in actions if action.option_strings), name


def test_quiet_leaves_errors(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Nothing on either stream of a run that ends well; what is wrong is said all the same."""
    write_mission(tmp_path / "m", simulate(scenario_config("demo", duration_s=12.0)).mission)
    words = ["smooth", str(tmp_path / "m"), "--out", str(tmp_path / "r"), "--figure", "pdf"]
    assert main([*words, "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")
    assert (tmp_path / "r/figure.pdf").read_bytes().startswith(b"%PDF")
    assert not (tmp_path / "r/figure.png").exists()
    assert main(["inspect", str(tmp_path / "m"), "--quiet", "--json"]) == 0
    assert capfd.readouterr().out.startswith("{")
    assert main(["smooth", str(tmp_path / "none"), "--out", str(tmp_path / "r"), "--quiet"]) == 2
    assert "mission.toml" in capfd.readouterr().err


def test_bash_completes(capfd: pytest.CaptureFixture[str]) -> None:
    """The script is one that bash takes, and proposes commands and options."""
    assert main(["completion", "bash"]) == 0
    script = capfd.readouterr().out
    ask = 'COMP_WORDS=(ssm-graph smo); COMP_CWORD=1; _shtab_ssm_graph; echo "${COMPREPLY[@]}"\n'
    ask += "COMP_WORDS=(ssm-graph smooth --adapt); COMP_CWORD=2; _shtab_ssm_graph; "
    ask += 'echo "${COMPREPLY[@]}"'
    done = subprocess.run(
        ["bash", "-c", f"{script}\n{ask}"], capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["smooth", "--adapt-noise"], done.stderr


@pytest.mark.parametrize(
    ("sentence", "begin_s", "epoch_s", "told"),
    [
        ("stuck; the first at 90.5 s", 30.0, None, "stuck; the first at 90.5 s (1.0 min)"),
        ("DVL, 120-180 s, 0.2 m/s: x", 0.0, None, "DVL, 120-180 s (2.0 to 3.0 min), 0.2 m/s: x"),
        (
            "from 1777629630.0 s to 1777629660.0 s: look",
            1777629600.0,
            None,
            "from 1777629630.0 s to 1777629660.0 s "
            "(0.5 to 1.0 min, 10:00:30 to 10:01:00 UTC): look",
        ),
        ("none at 60 s", 0.0, 1777629600.0, "none at 60 s (1.0 min, 10:01:00 UTC)"),
        (
            "none at 2e12 s, from 2000000000060 s",
            2e12,
            None,
            "none at 2e12 s, from 2000000000060 s (1.0 min)",
        ),
        ("gaps of 2.0 s, sigma 3.0 m", 0.0, None, "gaps of 2.0 s, sigma 3.0 m"),
    ],
)
def test_times_for_people(sentence: str, begin_s: float, epoch_s: float | None, told: str) -> None:
    """Minutes since the start, and UTC where it is known; lengths of time are left alone."""
    assert clocked(sentence, begin_s, epoch_s) == told


def test_crosses_do_not_bury_a_track() -> None:
    """Two hours of a survey with a bad beam in each tenth ping: one cross in a cell."""
    rng = np.random.default_rng(3)
    t = np.arange(7200.0)
    track = np.column_stack([100.0 * np.sin(t / 90.0), t * 0.05])
    marks = track[rng.random(len(t)) < 0.1]
    shown = marks[_apart(marks, track)]
    assert len(marks) > 600
    assert len(shown) < 0.3 * len(marks)
    reach = np.ptp(track, axis=0).max() / MARKS_ACROSS * np.sqrt(2.0)
    nearest = np.linalg.norm(marks[:, None] - shown[None], axis=2).min(axis=1)
    assert nearest.max() <= reach

"""Every block of code in the documentation runs, or is parsed by what it is written for."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import ssm_graph as sg
from ssm_graph.cli.main import build_parser, main
from ssm_graph.io.mission_folder.toml import LISTS, SECTIONS
from ssm_graph.live.protocols.json_messages import decode_message

ROOT = Path(__file__).parents[2]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.S | re.M)
OF_MISSIONS = {"mission-folder", "report-and-export", "choosing", "own-log"}
LONGEST_PARAGRAPH = 120
"""Words, of the method"""


class Block(NamedTuple):
    """One block of code of a page."""

    page: str
    kind: str
    text: str
    line: int


def blocks() -> Iterator[Block]:
    """Yield every block, in the order of the pages."""
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        for found in BLOCK.finditer(text):
            yield Block(path.stem, found[1], found[2], text[: found.start()].count("\n") + 1)


BLOCKS = list(blocks())


def of_kind(*kinds: str) -> Any:
    """Return the parameter of a test: the blocks of a kind."""
    chosen = [block for block in BLOCKS if block.kind in kinds]
    assert chosen
    names = [f"{block.page}:{block.line}" for block in chosen]
    return pytest.mark.parametrize("block", chosen, ids=names)


def test_every_block_has_a_kind_that_is_tested() -> None:
    """Formulas and output are ``text``; all else is looked at below."""
    kinds = {block.kind for block in BLOCKS}
    assert kinds <= {"", "sh", "python", "toml", "json", "text"}, kinds


@pytest.fixture(scope="session")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the pages talk about: a short mission and its result."""
    folder = tmp_path_factory.mktemp("docs")
    mission = sg.simulate(sg.scenario_config("demo", duration_s=30.0, seed=1)).mission
    sg.write_mission(folder / "out/demo/mission", mission)
    words = ["smooth", str(folder / "out/demo/mission"), "--no-figure"]
    main([*words, "--out", str(folder / "out/demo/result")])
    (folder / "first").symlink_to("out/demo")
    (folder / "MISSION").symlink_to("out/demo/mission")
    return folder


@of_kind("python")
def test_python_runs(block: Block, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it stands, in a folder with a mission and a result."""
    monkeypatch.chdir(workplace)
    exec(compile(block.text, f"{block.page}.md:{block.line}", "exec"), {})


@of_kind("toml")
def test_toml_is_read(block: Block) -> None:
    """And of mission folders every section and key is one that is known."""
    found = tomllib.loads(block.text)
    assert found
    if block.page not in OF_MISSIONS or "faults" in found:
        return
    for name, content in found.items():
        if isinstance(content, dict | list):
            known = {**SECTIONS, **LISTS}[name]
            for section in content if isinstance(content, list) else [content]:
                assert set(section) <= set(known), name


@of_kind("json")
def test_json_is_a_message(block: Block) -> None:
    """Each line."""
    for line in block.text.splitlines():
        decode_message(line)


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of every command of a block."""
    for line in re.sub(r"\\\n\s*", " ", text).splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield words


@of_kind("", "sh")
def test_commands_have_these_options(block: Block, capsys: pytest.CaptureFixture[str]) -> None:
    """Of our own every word is parsed; makes have their targets, extras and modules are there."""
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for program, *words in commands(block.text):
        if words == ["--version"]:
            continue
        if program == "ssm-graph":
            try:
                build_parser(words).parse_args(words)
            except SystemExit:
                pytest.fail(f"{words}: {capsys.readouterr().err}")
        elif program == "make":
            assert words[0] in targets
        elif program == "pip":
            wanted = re.findall(r"\[(.*)\]", words[-1])
            assert set(",".join(wanted).split(",")) - {""} <= set(extras["optional-dependencies"])
        elif program == "python":
            place = Path(*words[1].split(".")) if words[0] == "-m" else Path(words[0])
            assert (ROOT / place).exists() or (ROOT / place).with_suffix(".py").exists()
        else:
            pytest.fail(f"{block.page}.md:{block.line}: nobody tests {program!r}")


def test_paragraphs_of_the_method_are_short() -> None:
    """One idea each."""
    text = BLOCK.sub("", (ROOT / "docs/method.md").read_text(encoding="utf-8"))
    for paragraph in re.split(r"\n\s*\n", text):
        if not paragraph.startswith(("|", "#", "1. ")):
            assert len(paragraph.split()) <= LONGEST_PARAGRAPH, paragraph[:60]


def test_drawings_are_those_of_the_code() -> None:
    """``python docs/draw.py`` makes the files that are there."""
    spec = spec_from_file_location("draw", ROOT / "docs/draw.py")
    assert spec is not None
    assert spec.loader is not None
    draw = module_from_spec(spec)
    spec.loader.exec_module(draw)
    for name, content in draw.drawings().items():
        assert (ROOT / "docs" / name).read_text(encoding="utf-8") == content, name


@pytest.mark.slow
def test_the_first_mission_goes_as_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command and every block of that page, one after the other."""
    monkeypatch.chdir(tmp_path)
    for block in BLOCKS:
        if block.page != "first-mission":
            continue
        if block.kind == "python":
            exec(compile(block.text, "first-mission.md", "exec"), {})
        for program, *words in commands(block.text) if block.kind == "sh" else ():
            if program == "ssm-graph" and words != ["--version"]:
                assert main(words) == 0, words
    assert (tmp_path / "first/result/report.html").stat().st_size > 1_000_000
    assert len(list((tmp_path / "first/result-export").iterdir())) == 3
    summary = json.loads((tmp_path / "first/result/summary.json").read_text())
    assert np.isfinite(summary["rmse_horizontal_m"])


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Strictly, and with nothing in it that a browser would fetch from elsewhere."""
    pytest.importorskip("mkdocs")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    done = subprocess.run(
        [*words, "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    pages = sorted((tmp_path / "site/docs").glob("*.html"))
    assert len(pages) > 15
    for page in pages:
        outside = re.findall(r'(?:src|href)="https?://[^"]*\.(?:js|css|woff2?)"', page.read_text())
        assert not outside, page

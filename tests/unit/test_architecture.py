"""Imports point one way, files and functions stay small, only the border prints."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
MODULES = sorted(path for top in ("factors", "ssm_graph") for path in (ROOT / top).rglob("*.py"))

VALUES = {"base", "sensors", "mission.values"}
"""What every room may read: the foundation, instruments, missions and answers as frozen values."""
SYSTEMS = sorted(
    f"systems.{path.parent.name}" for path in (ROOT / "ssm_graph/systems").glob("*/__init__.py")
)
OF_SYSTEMS = VALUES | {
    "factors",
    "engine",
    "imu",
    "filters.rules",
    "graph.aids",
    "mission",
    "graph",
}
OF_SYSTEMS |= {"smoothers", "io", "simulation", "evaluation", "study", "report"}
"""A system takes what it needs of the house, but for what runs on the vehicle, and no system."""
MAY_IMPORT = {
    "factors": set[str](),
    "base": set[str](),
    "sensors": {"base"},
    "imu": {"base", "sensors", "factors"},
    "systems": set[str](),
    "engine": {"base", "factors"},
    "mission.values": {"base", "sensors"},
    "graph.aids": VALUES | {"engine", "imu", "factors"},
    "mission": VALUES | {"graph.aids", "engine", "imu", "factors"},
    "graph": VALUES | {"graph.aids", "mission", "engine", "imu", "factors"},
    "smoothers": VALUES | {"graph", "graph.aids", "mission", "engine", "imu", "factors"},
    "filters.rules": {"base", "engine", "factors"},
    "filters": VALUES | {"filters.rules", "graph.aids", "mission", "engine", "imu", "factors"},
    "io": VALUES,
    "live": VALUES | {"io"},
    "live.estimator": VALUES
    | {"smoothers", "graph", "graph.aids", "mission", "engine", "imu", "factors"},
    "simulation": VALUES,
    "evaluation": VALUES,
    "study": VALUES
    | {"smoothers", "filters", "graph", "mission", "engine", "simulation", "evaluation"}
    | {"factors", "io"},
    "report": VALUES | {"evaluation"},
    "result": VALUES | {"io", "smoothers", "evaluation", "report"},
    "inspection": VALUES | {"io", "live", "mission", "report"},
    **dict.fromkeys(SYSTEMS, OF_SYSTEMS),
}
"""Rooms that each room may import, itself apart; the rest may import anything."""
MISSION_VALUES = {
    f"ssm_graph.mission.{name}"
    for name in ("mission", "vehicle", "fault", "estimate", "navigation", "run_status", "events")
}
MISSION_VALUES |= {"ssm_graph.mission.point", "ssm_graph.mission.posterior"}
TOP = {"", "cli", "__main__"}
"""The package's own namespace and its command line stand above everything."""
MAY_PRINT = {"cli", "report"}
WITHOUT_GTSAM = {*VALUES, "io", "live", "simulation", "evaluation", "report"}
MAX_FILE_LINES = 450
MAX_FUNCTION_LINES = 60

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def parse(path: Path) -> ast.Module:
    """Return the syntax tree of a module."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


@cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of a module."""
    return tuple(ast.walk(parse(path)))


def name_of(path: Path) -> str:
    """Return a module's path from the root on, as offenders are listed."""
    return path.relative_to(ROOT).as_posix()


def dotted_name(path: Path) -> str:
    """Return a module's dotted name; a package goes by the name of its folder."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def part_of(module: str) -> str:
    """Return the room that a dotted name belongs to, ``""`` for the top."""
    top, *rest = module.split(".")
    if top == "factors":
        return "factors"
    if any(module == value or module.startswith(f"{value}.") for value in MISSION_VALUES):
        return "mission.values"
    pair = ".".join(rest[:2])
    return pair if pair in MAY_IMPORT else rest[0] if rest else ""


def imported_modules(nodes: Iterable[ast.AST], *, module: str, is_package: bool) -> Iterator[str]:
    """Yield the dotted names that a module of these nodes imports, wherever in it."""
    package = module.split(".") if is_package else module.split(".")[:-1]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            prefix = ".".join([*base, *([node.module] if node.module else [])])
            # ``from ssm_graph import io`` names a part, ``from ssm_graph.io import x`` its content.
            yield from (f"{prefix}.{alias.name}" for alias in node.names)


@cache
def imports_of(path: Path) -> set[str]:
    """Return the dotted names that a file imports."""
    name = dotted_name(path)
    return set(imported_modules(nodes_of(path), module=name, is_package=path.stem == "__init__"))


def own_parts(path: Path) -> set[str]:
    """Return the parts of this project that a file imports."""
    own = [name for name in imports_of(path) if name.split(".")[0] in {"ssm_graph", "factors"}]
    return {part_of(name) for name in own}


def test_every_part_is_known() -> None:
    """A new part has to be given its place in the table."""
    assert len(MODULES) > 40
    assert {part_of(dotted_name(path)) for path in MODULES} <= set(MAY_IMPORT) | TOP


def test_imports_point_one_way() -> None:
    """Data flows one way, imports point the other."""
    forbidden = {}
    for path in MODULES:
        part = part_of(dotted_name(path))
        if part not in TOP:
            forbidden[name_of(path)] = own_parts(path) - MAY_IMPORT[part] - {part}
    assert not {name: parts for name, parts in forbidden.items() if parts}


def test_gtsam_stays_in_its_place() -> None:
    """Data, files, simulation and evaluation work without GTSAM; factors with it and NumPy only."""
    known = {"gtsam", "numpy", "__future__", "abc", "collections", "dataclasses", "math"}
    known |= {"typing", "enum", "functools"}
    forbidden = {}
    for path in MODULES:
        part = part_of(dotted_name(path))
        outside = {name.split(".")[0] for name in imports_of(path)} - {"ssm_graph", "factors"}
        if part in WITHOUT_GTSAM:
            forbidden[name_of(path)] = outside & {"gtsam"}
        elif part == "factors":
            forbidden[name_of(path)] = outside - known
    assert not {name: outside for name, outside in forbidden.items() if outside}


def test_missions_of_files_and_logs_are_made_through_one_door() -> None:
    """No reader and no converter chooses its own checks: each hands its logs to the assembly."""
    makers = {
        str(path.relative_to(ROOT / "ssm_graph" / "io"))
        for path in MODULES
        if part_of(dotted_name(path)) == "io"
        for node in nodes_of(path)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "Mission"
    }
    assert makers == {"mission_folder/assembly.py"}


def test_import_rules_see_every_form_of_import() -> None:
    """The parser behind the rules: absolute, relative, aliased and local imports."""
    source = """
import ssm_graph.io.results.tables as m
from ssm_graph import graph
from . import sibling
from ..smoothers.batch import SsmSmoother
def f():
    from factors import dvl_beam
"""
    found = set(
        imported_modules(
            ast.walk(ast.parse(source)), module="ssm_graph.evaluation.x", is_package=False
        )
    )
    assert found == {
        "ssm_graph.io.results.tables",
        "ssm_graph.graph",
        "ssm_graph.evaluation.sibling",
        "ssm_graph.smoothers.batch.SsmSmoother",
        "factors.dvl_beam",
    }
    assert {part_of(name) for name in found} == {
        "io",
        "graph",
        "evaluation",
        "smoothers",
        "factors",
    }


def test_modules_are_documented_and_small() -> None:
    """Every module says what it is for, on at most 450 lines."""
    assert not [name_of(path) for path in MODULES if not ast.get_docstring(parse(path))]
    lines = {name_of(path): len(path.read_text("utf-8").splitlines()) for path in MODULES}
    assert not {name: n for name, n in lines.items() if n > MAX_FILE_LINES}


def code_lines(function: Function) -> int:
    """Return a function's length without its docstring."""
    assert function.end_lineno is not None
    length = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function) is not None:
        docstring = function.body[0]
        assert docstring.end_lineno is not None
        length -= docstring.end_lineno - docstring.lineno + 1
    return length


def test_functions_are_small() -> None:
    """One idea, one function."""
    assert not [
        f"{name_of(path)}:{node.lineno} {node.name}, {code_lines(node)} lines"
        for path in MODULES
        for node in nodes_of(path)
        if isinstance(node, Function) and code_lines(node) > MAX_FUNCTION_LINES
    ]


def test_only_the_border_prints() -> None:
    """The library returns values; command line and reports talk."""
    assert not [
        f"{name_of(path)}:{node.lineno}"
        for path in MODULES
        if part_of(dotted_name(path)) not in MAY_PRINT
        for node in nodes_of(path)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "print"
    ]


def names_of_own_values(nodes: Iterable[ast.AST]) -> set[str]:
    """Return the names that a function of these nodes binds to what it made and so may fill in.

    That is the result of a call, of ``copy.copy`` or ``cls.__new__`` for example; what a parameter,
    a loop or an attribute names belongs to somebody else.
    """
    return {
        target.id
        for node in nodes
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


def writes_of(nodes: Collection[ast.AST]) -> Iterator[tuple[int, str]]:
    """Yield line and text of every write to a value that the writer did not make itself."""
    inside: dict[int, Function] = {}
    own_of = {}
    for function in (node for node in nodes if isinstance(node, Function)):
        within = tuple(ast.walk(function))
        inside |= dict.fromkeys(map(id, within), function)
        own_of[function] = {"self", "cls"} | names_of_own_values(within)
    for node in nodes:
        if not isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign | ast.Call):
            continue
        writer = inside.get(id(node))
        own = own_of[writer] if writer else {"self", "cls"}
        targets: list[ast.expr] = []
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, ast.AugAssign | ast.AnnAssign):
            targets = [node.target]
        for target in targets:
            for part in ast.walk(target):
                if not (isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store)):
                    continue
                owner = part.value
                is_own = isinstance(owner, ast.Name) and owner.id in own
                if not is_own:
                    yield part.lineno, ast.unparse(part)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if node.func.attr not in {"__setattr__", "setflags"}:
                continue  # to write out every call takes seconds
            called = ast.unparse(node.func)
            is_first = writer is not None and writer.name == "__post_init__"
            if called == "object.__setattr__" and not is_first:
                yield node.lineno, called
            if called.endswith(".setflags") and any(
                k.arg == "write" and isinstance(k.value, ast.Constant) and k.value.value is True
                for k in node.keywords
            ):
                yield node.lineno, called


MAY_WRITE = {
    "ssm_graph/cli/completion.py": {"action.complete"},
    "ssm_graph/io/raw_log/log.py": {"row.is_in_table"},
    "ssm_graph/io/ros/topics.py": {"topic.n_unstated", "topic.beams_d"},
    "ssm_graph/io/tables/checkpoint.py": {"archive.comment"},
    "ssm_graph/live/estimator/smoother.py": {
        "self._intake.horizon_s",
        "intake.horizon_s",
        "intake.shift_s",
    },
    "ssm_graph/live/sockets/feed.py": {"channel.fed_s", "channel.heard_s", "channel.decoder"},
    "ssm_graph/live/sockets/inputs.py": {"self._channel.heard_s", "self.feed.n_reconnects"},
    "ssm_graph/live/sockets/serial_port.py": {"self._channel.heard_s", "self.feed.n_reconnects"},
    "ssm_graph/report/mission/summary.py": {
        "table.columns[1].justify",
        "table.columns[0].min_width",
        "table.columns[4].justify",
    },
    "ssm_graph/study/jobs.py": {"worker.job", "deaths.in_a_row"},
}
"""By file: counters, channels and tables of others' libraries, none of them a value."""


def test_nobody_writes_what_another_made() -> None:
    """A value is what it was made as: who wants another makes another."""
    assert not [
        f"{name_of(path)}:{line} {text}"
        for path in MODULES
        for line, text in writes_of(nodes_of(path))
        if text not in MAY_WRITE.get(name_of(path), set())
    ]


def test_the_rule_sees_writes() -> None:
    """To a parameter, an attribute of an attribute, a frozen value; not to what was just made."""
    source = """
class A:
    def f(self, problem):
        self.x = 1
        made = B()
        made.y = 2
        problem.chain.gravity = 3
        self.chain.params.n_gravity = 4
        object.__setattr__(problem, "x", 1)
        problem.p_n.setflags(write=True)
        problem.n += 1
"""
    assert sorted(line for line, _ in writes_of(tuple(ast.walk(ast.parse(source))))) == [
        7,
        8,
        9,
        10,
        11,
    ]


UNITS = {"m", "m/s", "m/s^2", "rad", "rad/s", "s", "Hz", "deg", "m/sqrt(s)", "rad^2"}


def test_the_engine_holds_no_number_of_water() -> None:
    """Constants of the eliminations and schedules are pure numbers, sigmas and counts."""
    for path in MODULES:
        if part_of(dotted_name(path)) != "engine":
            continue
        body = parse(path).body
        for node, after in zip(body, [*body[1:], None], strict=True):
            if not isinstance(node, ast.Assign | ast.AnnAssign):
                continue
            if not any(isinstance(part, ast.Constant) for part in ast.walk(node)):
                continue
            said = after.value if isinstance(after, ast.Expr) else None
            text = said.value if isinstance(said, ast.Constant) else ""
            first = str(text).split(",")[0].split(";")[0].split(".")[0].strip()
            assert first not in UNITS, f"{path.name}: {ast.unparse(node)} is in {first}"

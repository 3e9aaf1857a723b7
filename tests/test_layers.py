"""Who may import whom, read off the syntax trees: the layers of the design, kept by a test."""

from __future__ import annotations

import ast
import graphlib
import sys
from collections import Counter
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]

# The rooms of tgslam from the bottom up: a room imports from its own line or one above it here, and never in a circle
RANKS = (
    {"camera", "errors", "geometry", "pixels", "types"},
    {"config", "configs", "files", "kernels"},
    {"device", "relative_motion"},
    {"ops"},
    {"planes", "synthetic"},
    {"recognition"},
    {"map"},
    {"boundary", "graph", "keyframing", "mapping", "preparation", "sensing", "tracking"},
    {"assembly", "datasets", "record", "slam"},
    {"adaptation", "evaluation", "output", "recording"},
    {"conversion", "exports", "inspection", "pipeline", "saving"},
    {"bench"},
    {"cli"},
    {"__main__"},
)
RANKED = {name: rank for rank, names in enumerate(RANKS) for name in names}
# What must never see ground truth
SYSTEM = {"adaptation", "assembly", "boundary", "preparation", "record", "sensing", "slam"}
SYSTEM |= {"graph", "keyframing", "map", "mapping", "planes", "recognition", "tracking"}
# Rooms that hold kernels' arguments themselves; all others go through `ops`
KERNEL_USERS = {"kernels", "ops", "synthetic", "bench"}


def modules() -> dict[str, ast.Module]:
    """Dotted name below tgslam (kernels.simd, slam, config.loader) -> its syntax tree."""
    trees = {}
    for folder, prefix in (
        (CHECKOUT / "tgslam", ""),
        (CHECKOUT / "kernels", "kernels."),
        (CHECKOUT / "configs", "configs."),
    ):
        for path in sorted(folder.rglob("*.py")):
            name = prefix + ".".join(path.relative_to(folder).with_suffix("").parts)
            trees[name.removesuffix(".__init__") or "__init__"] = ast.parse(path.read_text(encoding="utf-8"))
    return trees


MODULES = modules()


def imports(tree: ast.Module) -> set[str]:
    """Every module that the tree imports, at any depth; `from tgslam import render` counts as tgslam.ops.rasterize."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            inner = node.module in ("tgslam", "tgslam.kernels")
            found |= {f"{node.module}.{alias.name}" for alias in node.names} if inner else {str(node.module)}
    return found


def parts(module: str) -> str:
    """The room of tgslam that a module belongs to: `tgslam.config.loader` -> config."""
    return module.removeprefix("tgslam.").split(".")[0]


def external(tree: ast.Module) -> set[str]:
    """Top-level names of third-party packages."""
    tops = {name.split(".")[0] for name in imports(tree)}
    return tops - set(sys.stdlib_module_names) - {"tgslam", "__future__"}


def units_imported(name: str) -> set[str]:
    """The other units that a module imports."""
    targets = {target for target in imports(MODULES[name]) if target.startswith("tgslam.")}
    return {parts(target) for target in targets} - {parts(name), "__version__"}


def rank(unit: str) -> int:
    return RANKED[unit]


@pytest.mark.parametrize("name", [name for name in MODULES if name != "__init__"])
def test_imports_point_one_way(name: str) -> None:
    above = {unit for unit in units_imported(name) if rank(unit) > rank(parts(name))}
    assert not above, f"{name} imports from the layers above it: {above}"


def test_no_unit_imports_itself_in_a_circle() -> None:
    graph: dict[str, set[str]] = {}
    for name in MODULES:
        graph.setdefault(parts(name), set()).update(units_imported(name))
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError that names the circle


@pytest.mark.parametrize("name", [name for name in MODULES if parts(name) == "kernels"])
def test_kernels_are_taichi_and_nothing_else(name: str) -> None:
    tree = MODULES[name]
    assert external(tree) <= {"taichi"}
    allowed = {"__future__", "collections.abc", "functools", "math", "taichi"}
    for target in imports(tree):
        assert target in allowed or target.split(".")[0] == "taichi" or target.startswith("tgslam.kernels"), target


@pytest.mark.parametrize("name", ["camera", "types", "geometry", "errors", "pixels"])
def test_types_and_geometry_need_numpy_only(name: str) -> None:
    assert external(MODULES[name]) <= {"numpy"}


def test_one_module_starts_taichi() -> None:
    def calls_init(tree: ast.Module) -> bool:
        calls = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call))
        return any(
            isinstance(call, ast.Attribute)
            and call.attr == "init"
            and isinstance(call.value, ast.Name)
            and call.value.id in ("ti", "taichi")
            for call in calls
        )

    assert [name for name, tree in MODULES.items() if calls_init(tree)] == ["device.runtime"]


def test_gtsam_stays_in_the_pose_graph() -> None:
    users = {name for name, tree in MODULES.items() if "gtsam" in external(tree)}
    assert users <= {"graph.factors", "graph.pose_graph", "graph.solvers"}  # what the pose graph is made of


@pytest.mark.parametrize("name", [name for name in MODULES if parts(name) in SYSTEM])
def test_the_system_cannot_reach_ground_truth(name: str) -> None:
    forbidden = {"datasets", "evaluation", "output", "pipeline", "cli", "synthetic"}
    seen: set[str] = set()
    todo = [name]
    while todo:
        for target in imports(MODULES[todo.pop()]):
            inner = target.removeprefix("tgslam.")
            if target.startswith("tgslam.") and inner not in seen:
                seen.add(inner)
                assert parts(inner) not in forbidden, f"{name} reaches {inner}"
                if inner in MODULES:
                    todo.append(inner)


def test_only_ops_call_kernels() -> None:
    users = {parts(name) for name, tree in MODULES.items() if any("tgslam.kernels" in i for i in imports(tree))}
    assert users <= KERNEL_USERS


def test_no_module_name_is_used_twice() -> None:
    """Wrappers are named like the kernels that they wrap, and CUDA's kernels like those for the CPU."""
    stems = [
        path.stem
        for folder in ("tgslam", "tools", "configs")
        for path in sorted((CHECKOUT / folder).rglob("*.py"))
        if not path.stem.startswith("__")
    ]
    twice = {stem for stem, count in Counter(stems).items() if count > 1}
    kernels = {path.stem for path in (CHECKOUT / "kernels").rglob("*.py")} - {"__init__"}
    others = {path.stem for path in (CHECKOUT / "tgslam").rglob("*.py") if path.parent.name != "ops"}
    assert not twice
    assert not kernels & others
    folders = {path.name for path in (CHECKOUT / "tgslam").rglob("*") if path.is_dir()}
    assert not folders & set(stems), "a module and a room of one name"


def stored_attributes(tree: ast.Module, *, of_others: bool) -> set[str]:
    """Names of attributes that the module assigns to, by statement or setattr; of_others: those of `self` left out."""
    stored = (n for n in ast.walk(tree) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store))
    calls = (n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name))
    by_setattr = {ast.unparse(call.args[1]).strip("'") for call in calls if call.func.id == "setattr"}  # type: ignore[attr-defined]
    return by_setattr | {n.attr for n in stored if not (of_others and ast.unparse(n.value) == "self")}


def written_views(tree: ast.Module) -> set[str]:
    """What the module writes into through a view of a column: `x.host("mean")[rows] = y`."""
    stored = (n for n in ast.walk(tree) if isinstance(n, ast.Subscript) and isinstance(n.ctx, ast.Store))
    views = (n.value for n in stored if isinstance(n.value, ast.Call) and isinstance(n.value.func, ast.Attribute))
    return {ast.unparse(view) for view in views if view.func.attr in ("host", "array")}  # type: ignore[attr-defined]


def test_keyframe_poses_are_assigned_in_one_module() -> None:
    poses = {"T_cw", "_T_cw", "_exposure", "_labels"}
    setters = {name for name, tree in MODULES.items() if stored_attributes(tree, of_others=True) & poses}
    assert setters == {"map.keyframes"}


def test_columns_of_gaussians_are_assigned_in_one_module() -> None:
    owner = "map.table"
    assert "capacity" in stored_attributes(MODULES[owner], of_others=False)
    columns = {"mean", "log_scale", "quat_wxyz", "opacity_logit", "plane_id", "birth_keyframe", "carriers", "capacity"}
    for name in (name for name in MODULES if parts(name) in SYSTEM and name != owner):
        assert not stored_attributes(MODULES[name], of_others=True) & columns, name
        assert not written_views(MODULES[name]), name


def attributes(cls: ast.ClassDef) -> set[str]:
    """Names that the body of a class assigns or annotates, and those that its methods assign to self."""
    body = [statement for statement in cls.body if isinstance(statement, (ast.Assign, ast.AnnAssign))]
    names = {n.id for s in body for n in ast.walk(s) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    stored = (n for n in ast.walk(cls) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store))
    return names | {n.attr for n in stored if ast.unparse(n.value) == "self"}


def test_classes_are_small() -> None:
    paths = [path for folder in ("tgslam", "kernels", "tools") for path in sorted((CHECKOUT / folder).rglob("*.py"))]
    nodes = [(path, n) for path in paths for n in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    classes = {f"{path.stem}.{n.name}": n for path, n in nodes if isinstance(n, ast.ClassDef)}
    assert len(classes) > 200
    assert {name: len(attributes(cls)) for name, cls in classes.items() if len(attributes(cls)) > 12} == {}
    lines = {name: (cls.end_lineno or 0) - cls.lineno + 1 for name, cls in classes.items()}
    assert {name: count for name, count in lines.items() if count > 200} == {}


def test_the_system_fits_on_one_screen() -> None:
    assert len((CHECKOUT / "tgslam" / "slam.py").read_text(encoding="utf-8").splitlines()) <= 130

"""A category from outside the package (tests/microwave.py): by object, by file, by dotted name."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from _helpers import microwave, tiny
from _helpers.frames import random_frames
from _helpers.shapes import outside_part
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.cli import generate
from caper_jax.config import GeneratorConfig, to_dict
from caper_jax.data import hdf5
from caper_jax.data.readers import open_dataset
from caper_jax.errors import CaperError
from caper_jax.estimator import load
from caper_jax.geometry.solids import bounds
from caper_jax.models.files import write_model
from caper_jax.synthetic.instances import build_bank, draw_instances
from caper_jax.tracker import load_tracker
from caper_jax.training import train as run
from caper_jax.training.objective import Objective

FILE = Path(microwave.__file__)


@pytest.fixture(autouse=True)
def clean(monkeypatch):
    """Leaves neither categories nor modules behind."""
    monkeypatch.setattr(categories, "_REGISTRY", dict(categories._REGISTRY))
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name.startswith(("caper_jax_user_module_", "kitchen")):
            del sys.modules[name]


def test_the_command_draws_frames_of_it(tmp_path):
    assert "microwave" not in categories.names()
    path = tmp_path / "frames.h5"
    options = {"frames": 12, "instances": 8, "points": 256, "grid": 40, "noise": "none"}
    options |= {"category": f"{FILE}:MICROWAVE", "out": path}
    arguments = [f"--{key}={value}" for key, value in options.items()]
    assert generate.run(generate.parse(arguments)) == 0
    dataset = hdf5.Hdf5Dataset(path)
    assert dataset.category is categories.get("microwave") and len(dataset) == 12
    for index in range(12):
        frame = dataset[index]
        pose, labels = frame.truth, frame.labels
        assert set(np.unique(labels)) <= {0, 1} and (labels == 0).any()
        assert outside_part(pose, frame.points, labels).max() < 2e-4
        # The door turns against the body by the state, about the joint.
        turn = Rotation.from_rotvec(pose.joint_axis[0] * pose.joint_state[0]).as_matrix()
        np.testing.assert_allclose(pose.rotation[0].T @ pose.rotation[1], turn, atol=1e-5)


def test_models_of_it_load_under_any_spelling(tmp_path, monkeypatch):
    """Cards keep the category's own name, whatever the training was told."""
    spelled = f"{FILE}:MICROWAVE"
    config = run.RunConfig(spelled, tiny.network(), GeneratorConfig(num_points=64))
    trained = []

    def skip(fit_task, config, category):
        trained.append((config, category, fit_task.keywords["description"]["category"]))
        return SimpleNamespace(finished=False), None

    with monkeypatch.context() as patch:
        patch.setattr(run, "_fit_generated", skip)
        patch.setattr(Objective, "init", lambda *_: {})
        run.train(config, tmp_path)
    (config, category, described), *_ = trained
    assert config.category == described == category.name == "microwave"

    card = {"category": config.category, "run": to_dict(config)}
    write_model(tmp_path / "model", tiny.random_variables(category, config.network), card)
    for name in (spelled, "microwave"):
        assert load(name, tmp_path / "model").category is category
    with pytest.raises(CaperError, match="a model of 'microwave', not 'box'"):
        load("box", tmp_path / "model")
    with pytest.raises(CaperError, match="no weights for 'microwave' ship"):
        load(spelled)


def test_datasets_open_under_any_spelling(tmp_path):
    path = tmp_path / "frames.h5"
    hdf5.write(path, category=microwave.MICROWAVE, split="test", **random_frames(3, 64))
    spelled = f"{FILE}:MICROWAVE"
    assert open_dataset("caper", path, spelled).category is categories.get(spelled)


def test_from_python_the_object_is_enough(tmp_path):
    category = microwave.MICROWAVE
    config = tiny.network("fast", pool_first=True)
    card = {"category": category.name, "run": {"network": to_dict(config)}}
    write_model(tmp_path, tiny.random_variables(category, config), card)
    assert load(category, tmp_path).category is category
    assert load_tracker(category, tmp_path).estimator.category is category
    assert "microwave" not in categories.names()
    assert categories.register(category) is category
    assert categories.get("microwave") is category and "microwave" in categories.names()


def test_the_example_keeps_its_own_conventions():
    models = draw_instances(microwave.MICROWAVE, 200, "train", 0)
    bank = build_bank(models)
    np.testing.assert_allclose(bank.size.mean(0), microwave.MICROWAVE.mean_size, atol=0.01)
    np.testing.assert_allclose(bank.box_center.mean(0), microwave.MICROWAVE.mean_center, atol=0.01)
    for model in models:
        low, high = bounds(model.parts[1])
        edge = np.array([high[0], 0.0, low[2]]) - model.pivot[0]
        opened = Rotation.from_rotvec(0.3 * model.axis[0]).apply(edge)
        assert opened[2] > edge[2] + 0.05  # the free edge comes out of the front


@pytest.mark.parametrize("absolute", [True, False])
def test_a_file_gives_its_category_once(absolute, monkeypatch):
    monkeypatch.chdir(FILE.parent)
    category = categories.get(f"{FILE}:MICROWAVE")
    other_spelling = f"{FILE}:MICROWAVE" if absolute else "microwave.py:MICROWAVE"
    assert categories.get(other_spelling) is category
    assert category.name == "microwave" and categories.get("microwave") is category


def test_a_dotted_name_gives_its_category(monkeypatch, tmp_path):
    package = tmp_path / "kitchen"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "oven.py").write_text(FILE.read_text())
    monkeypatch.syspath_prepend(tmp_path)
    assert categories.get("kitchen.oven:MICROWAVE") is categories.get("microwave")
    with pytest.raises(CaperError, match=r"no module 'kitchen\.stove'.* set PYTHONPATH"):
        categories.get("kitchen.stove:STOVE")
    with pytest.raises(CaperError, match=r"no module 'cellar'"):
        categories.get("cellar.oven:OVEN")


def write(folder: Path, content: str) -> str:
    path = folder / "broken.py"
    path.write_text(content)
    return str(path)


def test_mistakes_say_what_to_do(tmp_path):
    with pytest.raises(CaperError, match=r"no file .*absent\.py"):
        categories.get(f"{tmp_path / 'absent.py'}:MICROWAVE")
    with pytest.raises(CaperError, match=r"defines no 'OVEN' \(categories in it: MICROWAVE\)"):
        categories.get(f"{FILE}:OVEN")
    with pytest.raises(CaperError, match="shape as function, not as a Category"):
        categories.get(f"{FILE}:shape")
    with pytest.raises(CaperError, match=r"add which one it defines, .*microwave\.py:NAME"):
        categories.get(str(FILE))
    for incomplete in (":MICROWAVE", f"{FILE}:"):
        with pytest.raises(CaperError, match=r"give FILE\.py:NAME or package\.module:NAME"):
            categories.get(incomplete)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x = 1\ny = 1 / 0\n", r"broken\.py: importing it raised ZeroDivisionError.*line 2\)"),
        ("import no_such_module\n", r"ModuleNotFoundError: No module named 'no_such_module'"),
        ("def f(:\n", r"raised SyntaxError: .*line 1\)$"),
        ("raise SystemExit(0)\n", r"raised SystemExit: 0 \(.*broken\.py, line 1\)"),
    ],
)
def test_a_module_that_fails_is_an_error_every_time(tmp_path, content, message):
    name = f"{write(tmp_path, content)}:OVEN"
    for _ in range(2):
        with pytest.raises(CaperError, match=message):
            categories.get(name)


def test_taken_names_and_lists_are_refused(tmp_path):
    source = FILE.read_text()
    path = write(tmp_path, source.replace('name="microwave"', 'name="box"'))
    with pytest.raises(CaperError, match="'box' is already registered"):
        categories.get(f"{path}:MICROWAVE")
    categories.get(f"{FILE}:MICROWAVE")
    second = tmp_path / "second.py"
    second.write_text(source)
    with pytest.raises(CaperError, match="'microwave' is already registered"):
        categories.get(f"{second}:MICROWAVE")
    third = tmp_path / "third.py"
    third.write_text(source.replace('parts=("body", "door")', 'parts=["body", "door"]'))
    with pytest.raises(CaperError, match="'microwave': use tuples, not lists"):
        categories.get(f"{third}:MICROWAVE")


def test_files_cannot_choose_what_is_imported(tmp_path):
    """A data file that names a module as its category must not run it."""
    path = tmp_path / "frames.h5"
    name = f"{FILE}:MICROWAVE"
    hdf5.write(path, category=microwave.MICROWAVE, split="test", **random_frames(3, 64))
    with pytest.raises(CaperError, match="unknown category 'microwave'"):
        hdf5.Hdf5Dataset(path)
    with h5py.File(path, "r+") as file:
        file.attrs["category"] = name
    with pytest.raises(CaperError, match=r"unknown category '.*microwave\.py:MICROWAVE'"):
        hdf5.Hdf5Dataset(path)
    assert "microwave" not in categories.names()

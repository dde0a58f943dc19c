"""Many trainings in one program: each is that of a single run, whatever becomes of the others."""

from __future__ import annotations

import os
import signal
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _helpers.tiny import network

from caper_jax import categories
from caper_jax.config import GeneratorConfig, LoaderConfig, RunConfig, TrainingConfig, override
from caper_jax.errors import CaperError
from caper_jax.models.files import read_model
from caper_jax.synthetic.frames import Generator
from caper_jax.training import grid, grid_run, grid_step, train_many
from caper_jax.training import train as training
from caper_jax.training.grid import Member
from caper_jax.training.run_directory import read_metrics

BOX = categories.get("box")
BASE = RunConfig(
    category="box",
    network=network(pool_first=True),
    data=GeneratorConfig(instances=8, grid=16, num_points=64, noise=("none",)),
    training=TrainingConfig(
        # Its first steps are plain momentum; Adam's are of rounding where gradients are zero.
        optimizer="ranger",
        learning_rate=3e-3,
        warmup=2,
        batch_size=2,
        steps=6,
        log_steps=1,
        max_bad_steps=3,
        data_seed=0,
    ),
    calibration_frames=0,
)
# Three of one program, all numbers different.
RUNS = {
    "first": BASE,
    "second": override(BASE, "training.seed=1", "training.learning_rate=1e-3"),
    "third": override(BASE, "training.seed=2", "loss.weights.state=2", "loss.heatmap_gate=0.4"),
}


def trained(directory, runs=RUNS, **options):
    """{name: (weights, lines of metrics without their clock)} of members that were trained."""
    options.setdefault("devices", jax.devices()[:1])
    results = train_many.train_many(runs, directory, **options)
    assert all(result.finished for result in results)
    return {result.name: content(result.directory) for result in results}


def content(directory):
    lines = read_metrics(directory / "metrics.jsonl")
    clock = ("seconds", "rate")
    return (
        read_model(directory)[1],
        [{k: v for k, v in line.items() if k not in clock} for line in lines],
    )


def assert_close(a, b):
    """Of two runs, the metrics; and the weights, which are kept in half precision.

    The first step differs by rounding alone. Later that may move a point across the gate of the
    heatmap, or a point's part, so that some numbers of a step differ by more.
    """
    off = [
        [abs(one[key] - value) / max(abs(value), 0.01) for key, value in other.items()]
        for one, other in zip(a[1], b[1], strict=True)
    ]
    assert [one.keys() for one in a[1]] == [other.keys() for other in b[1]]
    assert max(off[0]) < 1e-4
    assert np.median(off) < 1e-3
    assert np.max(off) < 0.03
    for one, other in zip(jax.tree.leaves(a[0]), jax.tree.leaves(b[0]), strict=True):
        np.testing.assert_allclose(
            np.asarray(one, np.float32), np.asarray(other, np.float32), rtol=4e-3, atol=2e-3
        )


def assert_same_bits(a, b):
    assert a[1] == b[1]
    for one, other in zip(jax.tree.leaves(a[0]), jax.tree.leaves(b[0]), strict=True):
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


@pytest.fixture(scope="module")
def side_by_side(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("grid"))


@pytest.mark.parametrize("name", ["second", "third"])
def test_a_member_is_its_single_run(name, side_by_side, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "_mesh", lambda batch_size: None)  # one device, as there
    assert training.train(RUNS[name], tmp_path).finished
    assert_close(side_by_side[name], content(tmp_path))


def test_members_differ(side_by_side):
    losses = {lines[-1]["loss"] for _, lines in side_by_side.values()}
    assert len(losses) == 3


def test_an_interrupted_grid_ends_with_the_same_bits(side_by_side, tmp_path, monkeypatch, capsys):
    call, calls = grid_step.MembersStep.__call__, []

    def stop_once(self, *arguments):
        calls.append(1)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return call(self, *arguments)

    monkeypatch.setattr(grid_step.MembersStep, "__call__", stop_once)
    options = {"devices": jax.devices()[:1]}
    results = train_many.train_many(RUNS, tmp_path, **options)
    assert not any(result.ended for result in results)
    assert "stopped at step 3" in capsys.readouterr().err
    again = trained(tmp_path)
    assert len(calls) == 6
    for name in RUNS:
        assert_same_bits(again[name], side_by_side[name])


def test_a_grid_that_was_killed_while_it_wrote_models_trains_none_again(
    side_by_side, tmp_path, monkeypatch
):
    write, written = grid_run.write_run, []

    def break_off(*arguments):
        if written:
            raise OSError("disk full")
        written.append(write(*arguments))

    monkeypatch.setattr(grid_run, "write_run", break_off)
    with pytest.raises(OSError, match="disk full"):
        trained(tmp_path)
    monkeypatch.setattr(grid_run, "write_run", write)
    monkeypatch.setattr(grid_step.MembersStep, "__call__", None)  # no step is taken
    again = trained(tmp_path)
    for name in RUNS:
        assert_same_bits(again[name], side_by_side[name])
    assert not list((tmp_path / "programs").iterdir())


def test_a_diverging_member_leaves_the_others_alone(side_by_side, tmp_path, capsys):
    runs = RUNS | {"second": override(RUNS["second"], "training.learning_rate=1e30")}
    results = train_many.train_many(runs, tmp_path, devices=jax.devices()[:1])
    first, second, third = results
    assert (first.finished, second.finished, third.finished) == (True, False, True)
    assert second.diverged is not None and second.diverged <= 6
    assert "second diverged" in capsys.readouterr().err
    for name in ("first", "third"):
        assert_same_bits(content(tmp_path / name), side_by_side[name])
    again = train_many.train_many(runs, tmp_path)  # nothing is trained again
    assert [(r.finished, r.diverged) for r in again] == [(r.finished, r.diverged) for r in results]


def test_where_every_member_diverges_the_grid_says_so(tmp_path):
    runs = {name: override(config, "training.learning_rate=1e30") for name, config in RUNS.items()}
    with pytest.raises(CaperError, match="every member diverged by step"):
        train_many.train_many(runs, tmp_path, devices=jax.devices()[:1])


def test_devices_share_the_members(side_by_side, tmp_path):
    shared = trained(tmp_path, devices=jax.devices()[:3])
    for name in RUNS:
        assert_close(shared[name], side_by_side[name])


@pytest.mark.parametrize("seeds", [(3, 4, 5), (3, 4, 3)], ids=["own", "some"])
def test_devices_draw_the_frames_of_their_members(seeds):
    members = [
        Member(str(n), override(BASE, f"training.seed={n}", f"training.data_seed={seed}"))
        for n, seed in enumerate(seeds)
    ]
    group = grid.make_group(members, BOX, grid_run.draw_banks(members, BOX))

    def draw(data):
        streams, _, stream_of = data
        return grid_step.draw_batches(group, streams, jnp.int32(5), stream_of).points

    data, seen = grid_step.group_data(group), []
    for mesh in (None, grid_step.members_mesh(3, jax.devices()[:3])):
        run = grid_step.on_devices(draw, group, mesh, (), grid_step.SPLIT)
        seen.append(np.asarray(jax.jit(run)(data)))
    assert len({points.tobytes() for points in seen[0]}) == len(set(seeds))
    np.testing.assert_allclose(seen[1], seen[0], rtol=0, atol=1e-6)


def test_what_memory_does_not_hold_is_trained_in_parts(side_by_side, tmp_path, capsys):
    runs = {"first": BASE, "other": override(BASE, "training.seed=7")}
    parts = trained(tmp_path, runs, memory_gib=1e-6)
    said = capsys.readouterr().err
    assert "a step needs about" in said and "in 2 parts" in said
    assert_close(parts["first"], side_by_side["first"])
    assert parts["other"][1][0]["loss"] != parts["first"][1][0]["loss"]


def test_members_can_be_added_to_a_finished_grid(tmp_path):
    two = {name: RUNS[name] for name in ("first", "second")}
    before = trained(tmp_path, two)
    written = (tmp_path / "first" / "weights.npz").stat().st_mtime_ns
    other = replace(BASE, training=replace(BASE.training, seed=9))
    after = trained(tmp_path, two | {"fourth": other})
    assert (tmp_path / "first" / "weights.npz").stat().st_mtime_ns == written
    assert_same_bits(before["second"], after["second"])
    with pytest.raises(CaperError, match=r"training\.seed \(9 there, 8 now\)"):
        train_many.train_many(
            {"fourth": override(other, "training.seed=8")}, tmp_path, devices=jax.devices()[:1]
        )


def test_shapes_ask_for_programs_of_their_own():
    members = [
        Member("a", BASE),
        Member("b", override(BASE, "network.joints=direct")),
        Member("c", override(BASE, "training.seed=1", "loss.state_penalty=3")),
        Member("d", override(BASE, "loss.heatmap=scaled")),
        Member("e", override(BASE, "data.occlusion=0.5")),
        Member("f", override(BASE, "data.noise=kinect")),
    ]
    programs = grid.split_into_programs(members)
    assert [[m.name for m in program] for program in programs] == [
        ["a", "c", "f"],
        ["b"],
        ["d"],
        ["e"],
    ]
    with pytest.raises(CaperError, match=r"network\.joints .*voting in a, direct in b"):
        grid.make_group(members[:2], BOX, grid_run.draw_banks(members[:2], BOX))


@pytest.mark.parametrize("change", ["network.increment=euclidean", "category=laptop"])
def test_one_program_refuses_what_changes_shapes(change, tmp_path):
    runs = {"a": BASE, "b": override(BASE, change)}
    with pytest.raises(CaperError, match=change.partition("=")[0]):
        train_many.train_many(runs, tmp_path, one_program=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ({}, "no members"),
        ({"a": BASE, "b": BASE}, "b and a have the same settings"),
        ({"a": override(BASE, "training.minutes=3")}, "a: .*by steps"),
        ({"a": replace(BASE, loader=LoaderConfig("caper", "x"))}, "a: .*generated frames"),
    ],
)
def test_grids_that_cannot_be(runs, message, tmp_path):
    with pytest.raises(CaperError, match=message):
        train_many.train_many(runs, tmp_path)


@pytest.mark.parametrize(
    ("changes", "sharing"),
    [
        (((), ("training.seed=1",)), "all"),
        ((("training.data_seed=1",), ("training.data_seed=2",)), "own"),
        (((), ("data.occlusion=0.6",), ("training.seed=1",)), "some"),
        (((), ("data.noise=kinect",)), "own"),
    ],
)
def test_every_member_sees_the_frames_of_its_single_run(changes, sharing):
    """Disturbances and sensors are traced where they differ; frames stay the same."""
    base = override(BASE, "data.occlusion=0.9", "data.holes=0.5")
    members = [Member(str(n), override(base, *change)) for n, change in enumerate(changes)]
    group = grid.make_group(members, BOX, grid_run.draw_banks(members, BOX))
    assert group.sharing == sharing
    step = jnp.int32(5)
    draw = jax.jit(lambda streams: grid_step.draw_batches(group, streams, step))
    batches = draw(group.streams)
    for number, member in enumerate(members):
        training = member.config.training
        generator = Generator(BOX, member.config.data, seed=training.stream)
        key = grid_step.data_key(training.stream, 5)
        expected = generator.batch(key, training.batch_size)
        seen = batches if sharing == "all" else jax.tree.map(lambda x, n=number: x[n], batches)
        for one, other in zip(jax.tree.leaves(seen), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-5)

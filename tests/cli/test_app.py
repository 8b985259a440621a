"""What every command shares: configs found, help, and errors that name what is close."""

import json
import subprocess
import sys
import time

import pytest

from pnet.cli.app import chosen_operators, config_dir, run_name

COMMANDS = ("generate", "train", "evaluate", "report", "score", "info")


def test_configs_are_found_beside_the_source():
    assert (config_dir() / "train.yaml").is_file() and (config_dir() / "part" / "tn34.yaml").is_file()


def test_a_run_name_joins_what_says_something():
    assert run_name("tn34", "demo", "") == "tn34_demo"
    assert run_name("tn34", "demo", "data.root-a/b") == "tn34_demo_data.root-a-b"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_and_job_config(run_here, tmp_path, command):
    begin = time.perf_counter()
    outcome = run_here(tmp_path, command, "--help")
    assert outcome.code == 0 and f"pnet-{command}" in outcome.out
    given = {"evaluate": ["run=x"], "report": ["run=x"], "score": ["truth=x", "results=x", "poseutils=x"]}
    outcome = run_here(tmp_path, command, "--cfg", "job", *given.get(command, []))
    assert outcome.code == 0 and not outcome.err
    assert time.perf_counter() - begin < 20
    assert not list(tmp_path.iterdir())


def test_the_job_config_shows_every_group(run_here, tmp_path):
    out = run_here(tmp_path, "train", "--cfg", "job", "protocol=demo").out
    for key in (
        "backbone:",
        "model:",
        "loss:",
        "optimizer:",
        "schedule:",
        "postprocess:",
        "data:",
        "trainer:",
    ):
        assert f"\n{key}" in out
    assert "pnet.backbones.range_unet.RangeUNet" in out  # the demo's recipe


@pytest.mark.parametrize("command", COMMANDS)
def test_importing_a_command_is_light(command):
    """`--help` must not wait for torch."""
    code = (
        f"import sys, json; import pnet.cli.{command}; "
        "print(json.dumps([m for m in ('torch', 'lightning', 'trimesh', 'sklearn') if m in sys.modules]))"
    )
    from pathlib import Path

    import pnet

    source = str(Path(pnet.__file__).parents[1])
    code = f"import sys; sys.path.insert(0, {source!r}); " + code
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert json.loads(done.stdout) == []


MISSPELT = [
    ("train", "trainer.step=5", "trainer.step: unknown key, did you mean trainer.steps"),
    ("train", "sed=1", "sed: unknown key, did you mean seed"),
    ("train", "postprocess.clutser.bandwidth=1", "did you mean postprocess.cluster.bandwidth"),
    ("train", "backbone=pointnt2", "backbone=pointnt2: no such choice, did you mean pointnet2"),
    ("train", "part=tn43", "part=tn43: no such choice, did you mean"),
    ("train", "backbones=pointnet2", "backbones: unknown key, did you mean backbone"),
    ("train", "experiment=papr", "no such choice, did you mean paper"),
    ("generate", "camera=ensenso", "there are ensenso_n35"),
    ("generate", "camera.widht=10", "did you mean camera.width"),
    ("evaluate", "splt=val", "splt: unknown key, did you mean split"),
    ("score", "truht=x", "truht: unknown key, did you mean truth"),
    ("train", "zzz=1", "zzz: unknown key; `pnet-train --cfg job` lists all keys"),
    ("train", "seed=[1", "no viable alternative at input"),
]


@pytest.mark.parametrize(
    ("command", "override", "message"), MISSPELT, ids=[f"{c} {o}" for c, o, _ in MISSPELT]
)
def test_a_misspelt_word_is_answered_with_the_close_ones(run_here, tmp_path, command, override, message):
    assert message in run_here(tmp_path, command, override).error
    assert not list(tmp_path.iterdir())


BAD_GENERATION = [
    (("part=tn06", "part.learning.r=[20]"), "the hole (r = 20 mm) is as wide as the hexagon"),
    (("part.learning.h=[0]",), "parameters must be positive"),
    (("part.sections=7",), "expected a multiple of 6"),
    (("protocol.drop_limit=0",), "drop_limit, drop_step and points must be at least 1"),
    (("protocol.splits.val.first_cycle=0",), "share cycle 0"),
    (("+protocol.splits.test_l.clutter=0.5",), "clutter belongs in training only"),
    (("protocol.splits.train.objects=[16]",), "part object 16 is not in grid L"),
    (("camera.near=2",), "must be positive and below far"),
    (("part._target_=os.system",), "os.system is not allowed"),
    (("part._target_=pnet.parts.base.np.save",), "is not allowed"),
]


@pytest.mark.parametrize(
    ("overrides", "message"), BAD_GENERATION, ids=[" ".join(o) for o, _ in BAD_GENERATION]
)
def test_generation_refuses_and_writes_nothing(run_here, tmp_path, overrides, message):
    outcome = run_here(tmp_path, "generate", "protocol=smoke", "workers=0", *overrides)
    assert message in outcome.error
    assert not list(tmp_path.iterdir())


def test_a_traceback_can_be_asked_for(run_here, tmp_path, monkeypatch):
    monkeypatch.setenv("PNET_TRACEBACK", "1")
    with pytest.raises(ValueError, match="sed: unknown key"):
        run_here(tmp_path, "train", "sed=1")


def test_an_interruption_is_one_line_and_130(run_here, tmp_path, monkeypatch):
    def interrupted(cfg):
        raise KeyboardInterrupt

    monkeypatch.setattr("pnet.cli.score.score", interrupted)
    outcome = run_here(tmp_path, "score", "truth=a", "results=b", "poseutils=c")
    assert outcome.code == 130
    assert len(outcome.err.strip().splitlines()) == 1 and outcome.err.startswith("interrupted")


PLAIN = """
from pnet.cli.app import chosen_operators

with chosen_operators({choice!r}):  # before anything of torch is imported, as in a command
    import torch
    from pnet.ops.cpu import neighbours
    from pnet.ops.neighbours import octants
    from pnet.postprocess.kernels import kernels_for

    def fail(*_):
        raise LookupError("the kernel runs")

    neighbours.octants = fail
    octants(torch.rand(1, 9, 3), 0.1)
    print(kernels_for(torch.zeros(1)).name)
"""


def test_reference_operators_run_in_place_of_every_kernel():
    runs = {
        choice: subprocess.run(
            [sys.executable, "-c", PLAIN.format(choice=choice)], capture_output=True, text=True
        )
        for choice in ("reference", "kernels")
    }
    assert runs["reference"].stdout == "PLAIN\n", runs["reference"].stderr
    assert "LookupError: the kernel runs" in runs["kernels"].stderr


def test_another_choice_of_operators_is_refused():
    with pytest.raises(ValueError, match="ops is 'plain', choose kernels or reference"):
        chosen_operators("plain")


def test_info_prints_versions(run_here, tmp_path):
    outcome = run_here(tmp_path, "info")
    assert outcome.code == 0 and "torch" in outcome.out and "conf" in outcome.out

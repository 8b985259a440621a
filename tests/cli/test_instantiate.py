"""Configs are data: what they may build, and that all of them build."""

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from pnet.cli.app import config_dir
from pnet.cli.instantiate import instantiate

GROUPS = sorted(path.relative_to(config_dir()) for path in config_dir().glob("*/*.yaml"))
COMMANDS = sorted(path.stem for path in config_dir().glob("*.yaml") if path.stem != "training")
MAKING = {
    "part",
    "protocol",
    "camera",
    "bin",
    "physics",
    "clutter",
    "view",
}  # of pnet-generate; the others are of pnet-train


NEEDED = {
    "background/empty_bin": ["background.image=empty.png"],
    "background/limits": ["background.z=[0.3,0.64]"],
}


def targets(node, path=""):
    if isinstance(node, dict):
        if "_target_" in node:
            yield path
        for name, child in node.items():
            yield from targets(child, f"{path}.{name}".strip("."))


def build(cfg, path):
    """Build one node with what the commands give it besides."""
    from pnet.backbones.pointnet2 import Level, PointNet2
    from pnet.parts.tn34 import TN34

    node = OmegaConf.select(cfg, path)
    if node._target_.endswith(("ParametricNet", "PPRNet")):
        return instantiate(node, backbone=PointNet2([Level(8, 0.1, 4, [4])], [[4]]), keypoints=3)
    if node._target_.endswith("Loss"):
        return instantiate(node, part=TN34({"r": [18], "h": [16]}, {"r": [18], "h": [16]}))
    if node._target_.startswith("torch.optim"):
        return instantiate(node)([torch.nn.Parameter(torch.zeros(1))])
    return instantiate(node)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_composes_and_builds(command):
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        cfg = compose(command, return_hydra_config=True)
    assert cfg.hydra.job.config_name == command
    del cfg._content["hydra"]
    for path in targets(OmegaConf.to_container(cfg, resolve=False)):
        assert build(cfg, path) is not None


@pytest.mark.parametrize("config", GROUPS, ids=str)
def test_every_config_of_a_group_composes_and_builds(config: Path):
    group, choice = config.parent.name, config.stem
    command = "generate" if group in MAKING else "predict" if group == "background" else "train"
    overrides = [f"{group}={choice}", *NEEDED.get(f"{group}/{choice}", ())]
    if group == "data" and choice != "stored":
        overrides += ["data.root=.", *(["data.test_root=."] if choice == "ipa_sileane" else [])]
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        cfg = compose(command, overrides=overrides, return_hydra_config=True)
    assert cfg.hydra.runtime.choices[group] == choice
    plain = OmegaConf.to_container(cfg, resolve=False)
    plain.pop("hydra")
    found = list(targets(plain))
    for path in found:
        assert build(cfg, path) is not None


@pytest.mark.parametrize("protocol", ["paper", "demo"])
def test_the_papers_experiment_takes_the_papers_backbone(protocol):
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        cfg = compose("train", overrides=["experiment=paper", f"protocol={protocol}"])
    assert cfg.backbone._target_ == "pnet.backbones.pointsift.PointSIFT"


def test_every_option_has_a_comment():
    bare = []
    for path in config_dir().rglob("*.yaml"):
        assert path.read_text().startswith("#"), path
        if path.parent.name in ("ablation", "method", "refine", "launcher", "sweeper"):
            continue  # an overlay: its first lines say what it is for
        lines = [line.strip() for line in path.read_text().split("\nhydra:")[0].splitlines()]
        # of the entries of a list the first explains the keys
        told = {line.split(":")[0] for line in lines if "#" in line}
        for option in lines:
            plain = option.startswith(("#", "-", "_", "defaults:", "splits:")) or option.endswith((":", "}"))
            if option and not plain and option.split(":")[0] not in told and "{_target_" not in option:
                bare.append(f"{path.name}: {option}")
    assert not [line for line in bare if "defaults" not in line]


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "subprocess.run",
        "pnet.cli.app.os.system",
        "pnet.engine.provenance.subprocess.run",
        "torch.load",
        "pnetx.evil",
        "",
    ],
)
def test_what_is_not_on_the_list_is_refused(target):
    with pytest.raises(ValueError, match=r"part\.deep\._target_.* is not allowed; pnet builds only from"):
        instantiate(OmegaConf.create({"part": {"deep": {"_target_": target}}}))


@pytest.mark.parametrize(
    "target",
    [
        "torch.optim.sys.exit",
        "torch.optim.lr_scheduler.partial",
        "pnet.data.module.torch.load",
        "pnet.data.scene_folder.Path",
        "pnet.scenes.generation.os.system",
        "pnet.scenes.record_file.os.remove",
        "pnet.parts.base.np.save",
        "pnet.parts.tn34.DISC",
        "pnet.parts.tn34.TN34.__init__.__globals__",
        "pnet.parts.tn34.TN34.__subclasses__",
    ],
)
def test_what_is_only_imported_there_is_refused(target):
    with pytest.raises(ValueError, match=r"config\._target_.* (not allowed|does not exist)"):
        instantiate(OmegaConf.create({"_target_": target}))


def test_targets_in_lists_and_interpolations_are_checked_too():
    hidden = {"levels": [{"a": [{"_target_": "os.system"}]}]}
    with pytest.raises(ValueError, match=r"levels\[0\]\.a\[0\]\._target_: os\.system"):
        instantiate(OmegaConf.create(hidden))
    indirect = OmegaConf.create({"word": "os.system", "x": {"_target_": "${word}"}})
    with pytest.raises(ValueError, match=r"x\._target_: os\.system"):
        instantiate(indirect)


def test_a_target_that_does_not_exist_is_named():
    with pytest.raises(ValueError, match=r"pnet\.parts\.tn99\.TN99 does not exist"):
        instantiate(OmegaConf.create({"_target_": "pnet.parts.tn99.TN99"}))

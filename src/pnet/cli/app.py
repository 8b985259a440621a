"""What every command shares: where configs are, clear errors, exit codes."""

import difflib
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationToMissingValueError, MissingMandatoryValue, OmegaConfBaseException

from pnet.cli.instantiate import trusted_modules
from pnet.engine.locks import Busy

Task = Callable[[DictConfig], None]
LAUNCHERS = {"submitit": ("slurm", "hydra_submitit_launcher"), "ray": ("ray", "hydra_ray_launcher")}
LONGEST_NAME = 120  # of a folder, in characters
# what a user can mend; anything else is a fault of ours and keeps its traceback
EXPECTED = (ValueError, OSError, ModuleNotFoundError, HydraException, OmegaConfBaseException)
TRACEBACK = "PNET_TRACEBACK"  # set it to 1 to see where an error comes from


def config_dir() -> Path:
    """The folder of config groups: inside an installed package, or beside `src` in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "conf", package.parents[1] / "conf"):
        if (folder / "generate.yaml").is_file():
            return folder
    raise FileNotFoundError(f"pnet's config files are missing beside {package}; install pnet again")


def key_of(override: str) -> str:
    """The key of an override such as +a.b=1."""
    return override.split("=", 1)[0].lstrip("+~")


def config_flags(arguments: Sequence[str]) -> list[str]:
    """The flags by which the user brings configs of his own; each job needs them too."""
    found: list[str] = []
    for i, word in enumerate(arguments):
        name, _, value = word.partition("=")
        if name in ("--config-dir", "-cd", "--config-name", "-cn"):
            found += [name, value or arguments[i + 1]]
    return found


def hydra_value(value: Any) -> str:
    """Plain values as an override's right side."""
    match value:
        case None:
            return "null"
        case bool():
            return str(value).lower()
        case dict():
            return "{" + ",".join(f"{key}:{hydra_value(item)}" for key, item in value.items()) + "}"
        case list() | tuple():
            return "[" + ",".join(map(hydra_value, value)) + "]"
        case str():
            # Hydra takes a backslash as it is, except before a quote
            escaped = re.sub(r"(\\*)'", r"\1\1\\'", value)
            return "'" + re.sub(r"(\\+)$", r"\1\1", escaped) + "'"
        case _:
            return repr(value)


def run_name(*words: str) -> str:
    """A run folder's name: the words that say something, joined."""
    return short_name("_".join(word for word in words if word))


def short_name(text: str) -> str:
    """The text as one folder's name: no separators, and where it is long its beginning and a digest."""
    plain = re.sub(r"""[]['" ]""", "", text)
    plain = re.sub(r"[/\\]", "-", plain).replace(",", "+")
    if len(plain) <= LONGEST_NAME:
        return plain
    return f"{plain[: LONGEST_NAME - 9]}-{sha256(plain.encode()).hexdigest()[:8]}"


OmegaConf.register_new_resolver("run_name", run_name, replace=True)


def run_app(task: Task, config_name: str) -> None:
    """Run a command: compose its config, call the task, turn errors into one line and an exit code."""
    try:
        _check_launcher(sys.argv[1:])
        if trusted_modules():  # modules of the user's own may lie in the working directory
            sys.path.append(os.getcwd())
        folder = config_dir()
        _explain_bad_overrides(folder, config_name, sys.argv[1:])
        decorate = hydra.main(version_base="1.3", config_path=str(folder), config_name=config_name)
        decorate(_guarded(task))()
    except KeyboardInterrupt:
        print("interrupted: the same command goes on (pnet-train with ckpt=last)", file=sys.stderr)
        sys.exit(130)
    except EXPECTED as fault:
        fail(fault)


class CommandFailed(SystemExit):
    """Ends a command with exit code 1; `text` is what was printed."""

    def __init__(self, text: str) -> None:
        super().__init__(1)
        self.text = text


def fail(fault: BaseException) -> NoReturn:
    """Print one clear line and leave with exit code 1."""
    if os.environ.get(TRACEBACK) == "1":
        raise fault
    text = error_text(fault)
    if not isinstance(fault, Busy):  # the sweep says what it does about it
        print(f"error: {text}", file=sys.stderr)
    raise CommandFailed(text) from fault


def error_text(fault: BaseException) -> str:
    """What to tell the user, on one line."""
    if isinstance(fault, MissingMandatoryValue):
        return f"{fault.full_key} is missing: give {fault.full_key}=…; --help says what it is"
    if isinstance(fault, InterpolationToMissingValueError):  # names the key that points there
        found = re.search(r"Missing mandatory value: (\S+)", str(fault))
        key = found.group(1) if found else fault.full_key
        return f"{key} is missing: give {key}=…; --help says what it is"
    if isinstance(fault, InstantiationException) and fault.__cause__ is not None:
        return error_text(fault.__cause__)  # what our own constructor says is clearer than Hydra's wrapping
    lines = str(fault).strip().splitlines() or [type(fault).__name__]
    if lines[0].startswith("Caught "):  # a loader's worker sends its whole traceback: the end says it
        lines = lines[-1:]
    text = " ".join(" ".join(lines).split())
    if isinstance(fault, OSError) and fault.filename and fault.strerror:
        return f"{fault.filename}: {fault.strerror}"
    return text


def _guarded(task: Task) -> Task:
    """The task with its errors told here: Hydra would print a traceback."""

    def guarded(cfg: DictConfig) -> None:
        try:
            with chosen_operators(cfg.get("ops")):
                task(cfg)
        except EXPECTED as fault:
            if HydraConfig.get().mode == RunMode.MULTIRUN:  # a launcher would not see a SystemExit's reason
                raise RuntimeError(error_text(fault)) from fault
            fail(fault)

    return guarded


def chosen_operators(choice: str | None) -> AbstractContextManager[object]:
    """The setting `ops`: compiled kernels, or the plain torch references in their place."""
    if choice not in (None, "kernels", "reference"):
        raise ValueError(f"ops is {choice!r}, choose kernels or reference")
    if choice != "reference":
        return nullcontext()
    from pnet.ops.operators import plain_operators  # torch takes seconds to import
    from pnet.postprocess.kernels import Kernels, only

    stack = ExitStack()
    stack.enter_context(plain_operators())
    stack.enter_context(only(Kernels.PLAIN))
    return stack


def _check_launcher(arguments: list[str]) -> None:
    """Say which extra a launcher of a cluster is in, where it is not installed; Hydra would list files."""
    # ours adds a GPU, a time limit and queueing again to the plugin's own settings of the same name
    warnings.filterwarnings(
        "ignore", message=r"\s*'hydra/launcher/submitit_slurm' is validated", category=UserWarning
    )
    for word in arguments:
        name = word.partition("hydra/launcher=")[2]
        for prefix, (extra, plugin) in LAUNCHERS.items():
            if name.startswith(prefix) and find_spec(f"hydra_plugins.{plugin}") is None:
                raise ModuleNotFoundError(
                    f'hydra/launcher={name} needs an extra: pip install "pnet[{extra}]"'
                )


def _explain_bad_overrides(folder: Path, config_name: str, arguments: list[str]) -> None:
    """Raise ValueError that names close keys or choices where an override does not fit."""
    flags_with_value = {"--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn"}
    if flags_with_value & {a.split("=")[0] for a in arguments}:
        return  # the user brings configs of his own; Hydra itself checks them
    words = [a for a in arguments if "=" in a and not a.startswith("-")]
    overrides = OverridesParser.create().parse_overrides(words)
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(folder), version_base="1.3"):
        own = [o for o in overrides if not (o.key_or_group or "").startswith("hydra")]
        trials = [(override, trial) for override in own if (trial := _first_choice(override)) is not None]
        try:  # most often all is well, and composing takes a tenth of a second
            compose(config_name, overrides=[trial for _, trial in trials], return_hydra_config=True)
        except (HydraException, OmegaConfBaseException):
            _explain_first(folder, config_name, trials)
    GlobalHydra.instance().clear()


def _explain_first(folder: Path, config_name: str, trials: list[tuple[Override, str]]) -> None:
    """Raise ValueError about the first override with which composing fails."""
    good: list[str] = []
    for override, trial in trials:
        try:
            compose(config_name, overrides=[*good, trial], return_hydra_config=True)
        except (HydraException, OmegaConfBaseException) as fault:
            raise ValueError(_hint(folder, config_name, override, good, fault)) from fault
        good.append(trial)


def _first_choice(override: Override) -> str | None:
    """The override with the first value of its sweep; None where Hydra alone can list the values."""
    text = override.input_line or ""
    if not override.is_sweep_override():
        return text
    if not override.is_discrete_sweep() or "glob(" in text:
        return None
    first = next(iter(override.sweep_string_iterator()))
    return f"{text.split('=')[0]}={first}"


def _hint(folder: Path, config_name: str, override: Override, good: list[str], fault: Exception) -> str:
    key, value = override.key_or_group or "", str(override.value())
    choices = sorted(path.stem for path in (folder / key).glob("*.yaml")) if key else []
    if choices and value not in choices:
        near, others = closest(value, choices), [path.parent.name for path in folder.glob(f"*/{value}.yaml")]
        near = f", did you mean {others[0]}={value}?" if others else near
        return f"{key}={value}: no such choice{near}; there are {', '.join(choices)}"
    cfg = compose(config_name, overrides=good)
    groups = [path.name for path in folder.iterdir() if path.is_dir()]
    keys = list(dict.fromkeys([*key_paths(OmegaConf.to_container(cfg)), *groups]))
    if key not in keys:
        return f"{key}: unknown key{closest(key, keys)}; `{Path(sys.argv[0]).name} --cfg job` lists all keys"
    return f"{override.input_line}: {str(fault).splitlines()[0]}"


def closest(word: str, known: list[str]) -> str:
    """ ", did you mean …?" with the known words that are nearest, or nothing."""
    found = difflib.get_close_matches(word, known, n=3, cutoff=0.5)
    tail = word.rsplit(".", 1)[-1]
    found = found or [k for k in known if k.rsplit(".", 1)[-1] == tail][:3]
    return f", did you mean {' or '.join(found)}?" if found else ""


def key_paths(node: Any, path: str = "") -> Iterator[str]:
    """Every key of nested settings, dotted."""
    if path:
        yield path
    if isinstance(node, dict):
        for name, child in node.items():
            yield from key_paths(child, f"{path}.{name}" if path else str(name))

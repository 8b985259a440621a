"""pnet-info: versions, devices and folders, for a bug report."""

from omegaconf import DictConfig

from pnet.cli.app import config_dir, run_app


def main() -> None:
    """Entry point."""
    run_app(info, "info")


def info(cfg: DictConfig) -> None:
    """Print what results depend on."""
    from rich.console import Console
    from rich.table import Table

    from pnet.engine.provenance import provenance

    table = Table(show_header=False)
    state = provenance(seed=0)
    packages = state.pop("packages")
    state.pop("seed")
    for name, value in {**state, "configs": config_dir(), **packages}.items():
        table.add_row(str(name), str(value))
    Console(soft_wrap=True).print(table)


if __name__ == "__main__":
    main()

"""Options that read and print all settings as one file."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from geogs.application.settings_file import read_settings, settings_text
from geogs.cli.answer import Answer
from geogs.cli.options import Given
from geogs.config import Config, ReconstructConfig
from geogs.config.setting import Basic, Settings

C = TypeVar("C", Config, ReconstructConfig)


@dataclass(frozen=True)
class ConfigOptions(Settings):
    """Options that read and print all settings as one file."""

    config_file: Annotated[Path | None, Basic("--config")] = None
    """Settings from a file; such as config.yaml of a result. Single ones given beside it win."""
    print_config: bool = False
    """Only print all settings, as --config takes them."""


def with_settings_file(config: C, given: Given) -> C:
    """The settings, those of the file of ``--config`` in their place where one is given.

    Raises InputError if it cannot be used.
    """
    path = given.get("config-file")
    return config if path is None else read_settings(Path(path), config)


def printed(config: Config | ReconstructConfig) -> Answer:
    """The settings as ``--print-config`` shows them."""
    return Answer(settings_text(config).rstrip(), {"config": asdict(config)})

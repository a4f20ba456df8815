"""The settings of every stage: classes, each with the defaults of its command, and presets by the command's name.

    from capture4d import configs, pipeline

    pipeline.register("capture", "work", "paper")  # a preset, by its name
    loose = configs.with_values(configs.RegistrationConfig(), {"sequence.relax": 0.4})
    pipeline.register("capture", "work", loose)

The fields are the options of the command line: `sequence.relax` is --registration.sequence.relax there. A value that is
none is refused as it is given.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar, cast

from capture4d.app.compare.config import CompareConfig
from capture4d.app.export.config import ExportConfig
from capture4d.app.importing.config import ImportConfig
from capture4d.app.onnx_models.config import OnnxConfig
from capture4d.calibration.config import CalibrationConfig, RigCheckConfig
from capture4d.captures.animations.config import RemovalConfig
from capture4d.errors import InputError
from capture4d.templates.config import TemplateConfig
from capture4d.texturing.config import TextureConfig
from capture4d.tracking.config import TrackingConfig
from data_synth import config as synth_config
from data_synth.config import BoardConfig, SynthConfig, TrainingSetConfig
from data_synth.drapes.config import DrapesConfig
from data_synth.scanner.config import ScanConfig
from data_synth.styles.config import STYLE_SETS, StyleSetConfig
from registration import config as registration_config
from registration.config import MeshRegistrationConfig, RegistrationConfig
from retarget.config import AnimateConfig, FitConfig
from retarget.mixture import config as mixture_config
from retarget.mixture.config import StyleFitConfig, StylesConfig
from wrinkles.normal_maps import config as wrinkle_config
from wrinkles.normal_maps.config import ApplyConfig, PairConfig, WrinkleConfig
from wrinkles.offset_images import config as offset_config
from wrinkles.offset_images.config import DrapeOffsetsConfig, OffsetConfig, PredictOffsetsConfig
from wrinkles.offset_images.editing.config import DrawConfig

__all__ = [
    "PRESETS", "AnimateConfig", "ApplyConfig", "BoardConfig", "CalibrationConfig", "CompareConfig",
    "DrapeOffsetsConfig", "DrapesConfig", "DrawConfig", "ExportConfig", "FitConfig", "ImportConfig",
    "MeshRegistrationConfig", "OffsetConfig", "OnnxConfig", "PairConfig", "PredictOffsetsConfig",
    "RegistrationConfig", "RemovalConfig", "RigCheckConfig", "ScanConfig", "StyleFitConfig", "StyleSetConfig",
    "StylesConfig", "SynthConfig", "TemplateConfig", "TextureConfig", "TrackingConfig", "TrainingSetConfig",
    "WrinkleConfig", "with_values",
]  # fmt: skip

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fit-styles": mixture_config.PRESETS,
    "offsets train": offset_config.PRESETS,
    "register": registration_config.PRESETS,
    "run": registration_config.PRESETS,
    "synth": {**synth_config.PRESETS, **synth_config.TRAINING_SETS},
    "synth-drapes": STYLE_SETS,
    "wrinkles train": wrinkle_config.PRESETS,
}
"""By the command, as its --preset names them. The first one is its default where it has one."""

Config = TypeVar("Config")


def with_values(config: Config, values: Mapping[str, object]) -> Config:
    """The same settings with some values changed.

    Args:
        values: by the path of their field, such as "sequence.relax".
    Raises:
        InputError: there is no such field, or it does not take the value.
    """
    return _with_values(config, {tuple(path.split(".")): value for path, value in values.items()}, "")


def _with_values(config: Any, values: Mapping[tuple[str, ...], object], before: str) -> Any:
    """All at once: what goes with each other may not go with what was there."""
    known = [field.name for field in dataclasses.fields(config)] if dataclasses.is_dataclass(config) else []
    changed = {}
    for name in dict.fromkeys(path[0] for path in values):
        if name not in known:
            expected = f"one of {', '.join(known)}" if known else "no more names"
            raise InputError(f"{before}{name}: expected {expected}, found '{name}'")
        inner = {path[1:]: value for path, value in values.items() if path[0] == name}
        changed[name] = inner[()] if () in inner else _with_values(getattr(config, name), inner, f"{before}{name}.")
    return cast(Any, dataclasses.replace)(config, **changed)

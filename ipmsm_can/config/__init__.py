"""The configuration of a drive: `drive.toml` in, frozen `DriveConfig` out."""

from ipmsm_can.config.explain import explain
from ipmsm_can.config.load import ConfigError, config_from, load_config, load_configs, parse_config
from ipmsm_can.config.model import OBSERVER_KINDS, DriveConfig

__all__ = [
    "OBSERVER_KINDS",
    "ConfigError",
    "DriveConfig",
    "config_from",
    "explain",
    "load_config",
    "load_configs",
    "parse_config",
]

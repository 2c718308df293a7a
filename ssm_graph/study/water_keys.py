"""Keys of a case about the water: its current, and a DVL that tracks it."""

from __future__ import annotations

from ssm_graph.base.errors import ConfigError
from ssm_graph.simulation import CurrentSettings, WaterTrack
from ssm_graph.study.toml_table import TomlTable


def read_current(case: TomlTable) -> CurrentSettings | None:
    """Return the current of a case; None where the key is missing."""
    table = case.table("current")
    if table is None:
        return None
    default = CurrentSettings()
    tide = table.number("tide_m_per_s", default.tide)
    tide_period_s = table.number("tide_period_s", default.tide_period_s)
    sigma = table.number("sigma_m_per_s", default.sigma)
    vertical_sigma = table.number("vertical_sigma_m_per_s", default.vertical_sigma)
    correlation_s = table.number("correlation_s", default.correlation_s)
    steady = table.numbers("steady_enu_m_per_s", default.steady_enu)
    if len(steady) != 3:
        raise table.fault(
            "steady_enu_m_per_s",
            expected="three numbers",
            got=steady,
            hint="along east, north, up, as [0.3, 0.0, 0.0]",
        )
    table.end()
    try:
        return CurrentSettings(
            steady_enu=(steady[0], steady[1], steady[2]),
            tide=tide,
            tide_period_s=tide_period_s,
            sigma=sigma,
            vertical_sigma=vertical_sigma,
            correlation_s=correlation_s,
        )
    except ConfigError as error:
        raise ConfigError(f"{table.where}: {error}") from error


def read_water_track(case: TomlTable) -> WaterTrack | None:
    """Return when the DVL of a case tracks the water; None where the key is missing."""
    table = case.table("water_track")
    if table is None:
        return None
    default = WaterTrack()
    noise = table.number("noise_m_per_s", default.noise)
    beams = table.counts("beams", default.beams)
    every = table.count("every", default.every)
    table.end()
    try:
        return WaterTrack(noise=noise, beams=beams, every=every)
    except ConfigError as error:
        raise ConfigError(f"{table.where}: {error}") from error

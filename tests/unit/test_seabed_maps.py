"""Maps of the seabed in every format: the same heights at the same places, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin
from scipy.io import netcdf_file

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import ConfigError, DataError
from ssm_graph.base.frozen import Array
from ssm_graph.base.projection import utm
from ssm_graph.io.seabed.raster import plane_of
from ssm_graph.io.seabed.read import read_seabed

LAT, LON = np.radians(59.3), np.radians(17.8)
FRAME = LocalFrame(float(LAT), float(LON), 20.0)
LATS = np.degrees(LAT) + np.arange(-30, 31) * 1e-4
LONS = np.degrees(LON) + np.arange(-40, 41) * 2e-4
"""About 11 m apart, 670 m by 910 m."""


def depth_at(lat_deg: Array, lon_deg: Array) -> Array:
    """Return a depth that splines follow to a millimetre, m."""
    return np.asarray(
        50.0
        + 4.0 * np.sin((lat_deg - np.degrees(LAT)) * 1500.0)
        + 3.0 * np.cos((lon_deg - np.degrees(LON)) * 800.0)
    )


DEPTH = depth_at(*np.meshgrid(LATS, LONS, indexing="ij"))


def geotiff(path: Path, values: Array, keys: tuple[int, ...], tie: tuple[float, ...]) -> None:
    """Write a GeoTIFF, rows from the north; a tie of sixteen is a transformation."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags.tagtype[33550] = tags.tagtype[33922] = tags.tagtype[34264] = 12
    tags.tagtype[34735] = 3
    if len(tie) == 16:
        tags[34264], tags[34735] = tie, keys
    else:
        tags[33550], tags[33922], tags[34735] = (*tie[6:], 0.0), tie[:6], keys
    tags.tagtype[42113] = 2
    tags[42113] = "-9999"
    Image.fromarray(values[::-1].astype(np.float32)).save(path, tiffinfo=tags)


def write_tif(path: Path) -> None:
    """Degrees, heights, the pixel an area."""
    tie = (0.0, 0.0, 0.0, LONS[0] - 1e-4, LATS[-1] + 0.5e-4, 0.0, 2e-4, 1e-4)
    geotiff(path, -DEPTH, (1, 1, 0, 2, 1025, 0, 1, 1, 2048, 0, 1, 4326), tie)


def write_gebco(path: Path) -> None:
    """NetCDF 4, as GEBCO names it, in whole centimetres with a scale."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["lat"], file["lon"] = LATS[::-1], LONS
        file["elevation"] = np.round(-DEPTH[::-1] * 1000.0).astype(np.int32)
        file["elevation"].attrs["scale_factor"] = 1e-3
        file["crs"] = 0


def write_classic(path: Path) -> None:
    """NetCDF 3 with depths."""
    with netcdf_file(path, "w") as file:
        for name, values in (("lat", LATS), ("lon", LONS)):
            file.createDimension(name, len(values))
            file.createVariable(name, "f8", (name,))[:] = values
        variable = file.createVariable("depth", "f8", ("lat", "lon"))
        variable[:] = DEPTH
        variable.positive = b"down"


def write_asc(path: Path) -> None:
    """ESRI ASCII with edges of cells; it has square cells, so half of the columns are made."""
    lons = np.arange(LONS[0], LONS[-1], 1e-4)
    values = -depth_at(*np.meshgrid(LATS, lons, indexing="ij"))
    rows = "\n".join(" ".join(f"{v:.4f}" for v in row) for row in values[::-1])
    path.write_text(
        f"ncols {len(lons)}\nnrows {len(LATS)}\nxllcorner {lons[0] - 5e-5:.9f}\n"
        f"yllcorner {LATS[0] - 5e-5:.9f}\ncellsize 0.0001\nNODATA_value -9999\n{rows}\n"
    )


def write_xyz(path: Path) -> None:
    """Longitude, latitude, depth and its sigma, in no order."""
    lat, lon = (a.ravel() for a in np.meshgrid(LATS, LONS, indexing="ij"))
    order = np.random.default_rng(0).permutation(lat.size)
    rows = zip(lon[order], lat[order], depth_at(lat, lon)[order], strict=True)
    lines = [f"{x:.6f},{y:.6f},{z:.4f},0.25" for x, y, z in rows]
    path.write_text("lon,lat,depth,sigma\n" + "\n".join(lines) + "\n")


def write_south_up(path: Path) -> None:
    """GeoTIFF whose rows begin in the south, with a hole that nothing names."""
    values = np.where(np.arange(DEPTH.size).reshape(DEPTH.shape) == 0, 1e35, -DEPTH)
    place = (2e-4, 0, 0, LONS[0] - 1e-4, 0, 1e-4, 0, LATS[0] - 0.5e-4, *(0.0,) * 7, 1.0)
    geotiff(path, values[::-1], (1, 1, 0, 2, 1025, 0, 1, 1, 2048, 0, 1, 4326), place)


def write_turned(path: Path) -> None:
    """NetCDF 3 over longitude and latitude at one time; depths that are heights."""
    with netcdf_file(path, "w") as file:
        for name, values in (("time", np.zeros(1)), ("lon", LONS), ("lat", LATS)):
            file.createDimension(name, len(values))
            file.createVariable(name, "f8", (name,))[:] = values
        file.createVariable("depth", "f4", ("time", "lon", "lat"))[:] = -DEPTH.T[None]


def write_utm(path: Path) -> None:
    """GeoTIFF in UTM, the pixel a point."""
    middle = utm(np.array([LAT]), np.array([LON]), of=(float(LAT), float(LON)))
    east = float(middle.easting[0]) + np.arange(-35, 36) * 10.0
    north = float(middle.northing[0]) + np.arange(-32, 33) * 10.0
    assert middle.zone == 33
    lat, lon = plane_of("EPSG:32633", "").inverse(*np.meshgrid(east, north))
    values = -depth_at(np.degrees(lat), np.degrees(lon))
    tie = (0.0, 0.0, 0.0, east[0], north[-1], 0.0, 10.0, 10.0)
    geotiff(path, values, (1, 1, 0, 2, 1025, 0, 1, 2, 3072, 0, 1, 32633), tie)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("map.tif", write_tif),
        ("gebco.nc", write_gebco),
        ("classic.nc", write_classic),
        ("map.asc", write_asc),
        ("map.xyz", write_xyz),
        ("utm.tif", write_utm),
        ("south_up.tif", write_south_up),
        ("turned.nc", write_turned),
    ],
)
def test_heights_of_every_format(name: str, write: Callable[[Path], None], tmp_path: Path) -> None:
    """Within 2 cm between the cells, above the ellipsoid, the datum taken into account."""
    write(tmp_path / name)
    grid = read_seabed(tmp_path / name, FRAME, datum_m=20.0)
    rng = np.random.default_rng(1)
    lat = LAT + np.radians(rng.uniform(-2e-3, 2e-3, 200))
    lon = LON + np.radians(rng.uniform(-5e-3, 5e-3, 200))
    want = 20.0 - depth_at(np.degrees(lat), np.degrees(lon))
    p_n = FRAME.p_n_from_geodetic(lat, lon, want)
    found = grid.surface_at(p_n[:, 0], p_n[:, 1]).height
    np.testing.assert_allclose(found, want, atol=0.02)
    assert (grid.sigma is None) == (name != "map.xyz")
    if grid.sigma is not None:
        np.testing.assert_allclose(grid.sigma[5:-5, 5:-5], 0.25, atol=1e-6)


def test_soundings_without_a_raster(tmp_path: Path) -> None:
    """They are gridded; a hole that is too large stays one."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-200.0, 200.0, (2, 4000))
    kept = np.hypot(x - 80.0, y) > 60.0
    rows = zip(x[kept], y[kept], -40.0 - 0.05 * x[kept] + 0.02 * y[kept], strict=True)
    path = tmp_path / "soundings.xyz"
    path.write_text("\n".join(f"{a:.3f} {b:.3f} {c:.4f}" for a, b, c in rows) + "\n")
    grid = read_seabed(path, FRAME, crs="local")
    found = grid.height_at(np.array([-100.0, 20.0, 80.0]), np.array([50.0, -120.0, 0.0]))
    np.testing.assert_allclose(found[:2], [-34.0, -43.4], atol=0.02)
    assert np.isnan(found[2])


def test_decimal_commas(tmp_path: Path) -> None:
    """Where semicolons part the columns, commas are those of decimals."""
    path = tmp_path / "m.csv"
    rows = (f"{5 * i},0;{5 * j},0;-4{i},5" for i in range(5) for j in range(5))
    path.write_text("x;y;z\n" + "\n".join(rows) + "\n")
    grid = read_seabed(path, FRAME, crs="local")
    np.testing.assert_array_equal(grid.height[0], [-40.5, -41.5, -42.5, -43.5, -44.5])


def test_sigmas_lie_where_the_heights_do(tmp_path: Path) -> None:
    """A raster of sigmas that is as large, but beside the map, is refused."""
    own, sigma = tmp_path / "m.asc", tmp_path / "sigma.asc"
    head, rows = "ncols 4\nnrows 4\nyllcorner 0\ncellsize 5\n", "1 2 3 4\n" * 4
    own.write_text("xllcorner 0\n" + head + rows)
    sigma.write_text("xllcorner 40\n" + head + rows)
    with pytest.raises(DataError, match=r"sigma\.asc.*8 cells beside it"):
        read_seabed(own, FRAME, crs="local", sigma=sigma)


def test_land_and_water_need_a_word(tmp_path: Path) -> None:
    """Values of both signs are heights or depths; what stands for none is no height of either."""
    path = tmp_path / "m.xyz"
    at = [(i, j) for i in range(6) for j in range(6)]
    path.write_text("".join(f"{10 * i} {10 * j} {9999 if i == j else i - 2}\n" for i, j in at))
    with pytest.raises(ConfigError, match="50 % of the values are above zero"):
        read_seabed(path, FRAME, crs="local")
    grid = read_seabed(path, FRAME, crs="local", is_down=True)
    assert np.isnan(np.diag(grid.height)).all()
    assert grid.height[0, 5] == -3.0


def test_what_stands_for_no_reading_is_no_height(tmp_path: Path) -> None:
    """Neither turns it heights into depths by its sign, nor do triangles lead up to it."""
    path = tmp_path / "m.nc"
    write_turned(path)
    with netcdf_file(path, "a") as file:
        file.variables["depth"][0, 0, :5] = 99999.0
    assert np.nanmax(read_seabed(path, FRAME).height) < 0.0
    rng = np.random.default_rng(2)
    soundings = np.column_stack([rng.uniform(0.0, 100.0, (400, 2)), rng.uniform(29.0, 31.0, 400)])
    soundings[:40, 2] = 9999.0
    path = tmp_path / "m.xyz"
    np.savetxt(path, soundings)
    height = read_seabed(path, FRAME, crs="local").height
    assert np.nanmin(height) >= -31.0
    assert np.nanmax(height) <= -29.0


def test_what_no_map_is(tmp_path: Path) -> None:
    """Each with file, place and what to try."""
    path = tmp_path / "m.asc"
    head = "ncols 4\nnrows 4\nxllcorner 0\nyllcorner 0\ncellsize 5\n"
    rows = "1 2 3 4\n" * 4
    for text, said in (
        ("1 2 3\n" * 30, "line 1: expected a header"),
        (head + "1 2 3 4\n" * 3, "16 in all, got 12"),
        (head + rows[:-2] + "x\n", "line 9: expected a number, got 'x'"),
        (head.replace("ncols 4", "ncols inf") + rows, "ncols: expected a count, got inf"),
        (head.replace("xllcorner 0\n", "") + rows, "line 5: expected a header with xllcorner"),
        (head.replace("cellsize 5", "cellsize nan") + rows, "steps from nan to nan"),
        (head + "-9999 " * 16, "no cell has a height"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=said):
            read_seabed(path, FRAME, crs="local")
    path.write_text(head + rows)
    with pytest.raises(ConfigError, match="does not say what its coordinates are"):
        read_seabed(path, FRAME)
    with pytest.raises(ConfigError, match="no place of its own"):
        read_seabed(path, None, crs="local")
    with pytest.raises(ConfigError, match="ends with"):
        read_seabed(tmp_path / "m.png", FRAME)
    xyz = tmp_path / "m.xyz"
    xyz.write_text("0 0 1\n0 1\n")
    with pytest.raises(DataError, match="line 2: expected x, y and z"):
        read_seabed(xyz, FRAME)
    for text, said in (
        ("".join(f"{i} {i} {-i}\n" for i in range(20)), "got them on a line"),
        ("0 0 1\nnan 1 1\n", "line 2: expected a place, got 'nan 1 1'"),
    ):
        xyz.write_text(text)
        with pytest.raises(DataError, match=said):
            read_seabed(xyz, FRAME)
    tif = tmp_path / "m.tif"
    Image.fromarray(np.zeros((8, 8), np.float32)).save(tif)
    with pytest.raises(DataError, match="does not say where it is"):
        read_seabed(tif, FRAME)
    keys, tie = (1, 1, 0, 2, 2048, 0, 1, 4326, 3072, 0, 1, 32767), (0.0,) * 6 + (10.0, 10.0)
    geotiff(tif, DEPTH, keys, tie)
    with pytest.raises(ConfigError, match="does not say what its coordinates are"):
        read_seabed(tif, FRAME)  # projected by rules of its own, from degrees that it names
    nc = tmp_path / "m.nc"
    with netcdf_file(nc, "w") as file:
        for name, size in (("lon", 5), ("lat", 4)):
            file.createDimension(name, size)
        for name in ("lon", "lat", "depth"):
            file.createVariable(name, "f8", ("lat", "lon"))[:] = 1.0
    with pytest.raises(DataError, match="turned or curved"):
        read_seabed(nc, FRAME)
    nc.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(40))
    with pytest.raises(DataError, match=r"m\.nc: expected NetCDF"):
        read_seabed(nc, FRAME)
    with netcdf_file(nc, "w") as file:
        file.createDimension("time", 3)
        file.createVariable("time", "f8", ("time",))[:] = 0.0
    with pytest.raises(DataError, match="expected variables lon, lat"):
        read_seabed(nc, FRAME)


def test_a_map_of_elsewhere(tmp_path: Path) -> None:
    """It is said how far away; a start without a place takes the map's own."""
    write_tif(tmp_path / "map.tif")
    with pytest.raises(DataError, match="km from the mission"):
        read_seabed(tmp_path / "map.tif", LocalFrame(0.3, 0.2, 0.0))
    frame = read_seabed(tmp_path / "map.tif", None).frame
    assert frame.lat == pytest.approx(float(LAT), abs=1e-6)
    assert frame.lon == pytest.approx(float(LON), abs=1e-6)

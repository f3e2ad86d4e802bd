"""Sources of virtual rasters: whatever their spelling, the tool knows all files that GDAL reads."""

import gzip
import html
import os
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.crs import CRS
from rasterio.rpc import RPC
from rasterio.transform import from_origin

from sat_intervals.raster import InputError, open_image, other_files, pixel_files, survey

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SIZE = 16
BAND = '<VRTRasterBand dataType="{}"{}><SimpleSource>{}<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand>'
SOURCE = '<SourceFilename relativeToVRT="{}">{}</SourceFilename>'

WARPED = (
    f'<VRTDataset rasterXSize="{SIZE}" rasterYSize="{SIZE}" subClass="VRTWarpedDataset"><SRS>EPSG:4326</SRS>'
    '<GeoTransform>5.4, 0.0125, 0, 43.6, 0, -0.0125</GeoTransform><VRTRasterBand dataType="UInt16" band="1" '
    'subClass="VRTWarpedRasterBand"/><BlockXSize>16</BlockXSize><BlockYSize>16</BlockYSize><GDALWarpOptions>'
    '<SourceDataset relativeToVRT="1">image.tif</SourceDataset><Transformer><GenImgProjTransformer>{}'
    "<DstGeoTransform>5.4,0.0125,0,43.6,0,-0.0125</DstGeoTransform>"
    "<DstInvGeoTransform>-432,80,0,3488,0,-80</DstInvGeoTransform></GenImgProjTransformer></Transformer>"
    '<BandList><BandMapping src="1" dst="1"/></BandList></GDALWarpOptions></VRTDataset>'
)

GRID = "5.4,0.0125,0,43.6,0,-0.0125"


def virtual(image, mask=""):
    """The text of a virtual raster of an image, with a mask from another source."""
    mask = f"<MaskBand>{BAND.format('Byte', '', mask)}</MaskBand>" if mask else ""
    band = BAND.format("UInt16", ' band="1"', SOURCE.format(*image))
    return f'<VRTDataset rasterXSize="{SIZE}" rasterYSize="{SIZE}">{band}{mask}</VRTDataset>'


def write(path, dtype="uint16", **profile):
    path.parent.mkdir(exist_ok=True)
    with rasterio.open(path, "w", "GTiff", SIZE, SIZE, 1, dtype=dtype, **profile) as file:
        file.write(np.ones((1, SIZE, SIZE), dtype))
        return file


@pytest.fixture
def folder(tmp_path):
    write(tmp_path / "image.tif")
    write(tmp_path / "mask.tif", "uint8")
    return tmp_path


def zipped(folder, name, file):
    with zipfile.ZipFile(folder / f"{name}.zip", "w") as archive:
        archive.write(folder / file, file)
    return f"/vsizip/{folder}/{name}.zip/{file}"


def compressed(folder, file):
    (folder / f"{file}.gz").write_bytes(gzip.compress((folder / file).read_bytes()))
    return f"/vsigzip/{folder}/{file}.gz"


MASKS = {
    "relative": lambda folder: (SOURCE.format(1, "mask.tif"), folder / "mask.tif"),
    "another number": lambda folder: (SOURCE.format(2, "mask.tif"), folder / "mask.tif"),
    "absolute": lambda folder: (SOURCE.format(0, folder / "mask.tif"), folder / "mask.tif"),
    "lines": lambda folder: (SOURCE.format(1, "\n  mask.tif"), folder / "mask.tif"),
    "entity": lambda folder: (SOURCE.format(1, "mask&#46;tif"), folder / "mask.tif"),
    "section": lambda folder: (SOURCE.format(1, "<![CDATA[mask.tif]]>"), folder / "mask.tif"),
    "like a subdataset": lambda folder: (
        SOURCE.format(1, (folder / "mask.tif").rename(folder / "A:mask.tif").name),
        folder / "A:mask.tif",
    ),
    "in an archive": lambda folder: (SOURCE.format(0, zipped(folder, "mask", "mask.tif")), folder / "mask.zip"),
    "compressed": lambda folder: (SOURCE.format(0, compressed(folder, "mask.tif")), folder / "mask.tif.gz"),
    "part of a file": lambda folder: (
        SOURCE.format(0, f"/vsisubfile/0_{(folder / 'mask.tif').stat().st_size},{folder}/mask.tif"),
        folder / "mask.tif",
    ),
}


def local_files(name):
    """The local files behind the names of a raster's other files."""
    return {re.sub(r"^/vsi\w+/(\d+_\d+,)?(.*\.(zip|gz)|.*).*", r"\2", file) for file in other_files(name)}


@pytest.mark.parametrize("spelling", MASKS)
def test_other_files__have_the_mask_of_a_virtual_raster_in_any_spelling(folder, spelling):
    mask, file = MASKS[spelling](folder)
    (folder / "image.vrt").write_text(virtual((1, "image.tif"), mask))
    assert open_image(folder / "image.vrt").use_mask
    assert local_files(str(folder / "image.vrt")) == {str(folder / "image.tif"), str(file)}


@pytest.mark.parametrize("is_absolute", [False, True])
def test_other_files__are_those_of_the_virtual_raster_that_a_link_names(folder, is_absolute):
    (folder / "image.vrt").write_text(virtual((1, "image.tif"), SOURCE.format(1, "mask.tif")))
    link = folder / "linked" / "image.vrt"
    write(folder / "linked" / "mask.tif", "uint8")  # another one
    link.symlink_to(folder / "image.vrt" if is_absolute else "../image.vrt")
    assert str(folder / "mask.tif") in map(os.path.realpath, other_files(str(link)))


def test_other_files__are_those_of_virtual_rasters_in_archives(folder):
    (folder / "image.vrt").write_text(virtual((0, folder / "image.tif"), SOURCE.format(0, folder / "mask.tif")))
    sources = {str(folder / "image.tif"), str(folder / "mask.tif")}
    assert sources <= set(other_files(zipped(folder, "image", "image.vrt")))
    (folder / "outer.vrt").write_text(virtual((0, compressed(folder, "image.vrt"))))
    assert sources <= set(other_files(str(folder / "outer.vrt")))


def test_other_files__are_those_beside_a_virtual_raster_in_an_archive(folder):
    (folder / "image.vrt").write_text(virtual((1, "image.tif"), SOURCE.format(1, "mask.tif")))
    with zipfile.ZipFile(folder / "all.zip", "w") as archive:
        for name in ("image.vrt", "image.tif", "mask.tif"):
            archive.write(folder / name, name)
    inside = f"/vsizip/{folder}/all.zip"
    assert other_files(f"{inside}/image.vrt") == [f"{inside}/image.tif", f"{inside}/mask.tif"]


def test_other_files__of_a_name_of_one_in_an_archive_are_the_archive(folder):
    name = zipped(folder, "image", "image.tif")
    assert other_files(f"vrt://{name}") == [name]


def test_other_files__are_those_of_warping_too(folder, monkeypatch):
    monkeypatch.chdir(folder)  # GDAL looks there for heights
    write(folder / "heights.tif", "float32", crs="EPSG:4326", transform=from_origin(5.3, 43.7, 0.03, 0.03))
    numbers = {"line": "0 0 -1" + 17 * " 0", "samp": "0 1" + 18 * " 0"}
    values = {"lat_off": 43.5, "long_off": 5.5, "height_off": 0, "line_off": 8, "samp_off": 8}
    values |= {"lat_scale": 0.1, "long_scale": 0.1, "height_scale": 500, "line_scale": 8, "samp_scale": 8}
    values |= {f"{side}_num_coeff": text for side, text in numbers.items()}
    values |= {f"{side}_den_coeff": "1" + 19 * " 0" for side in numbers}
    with rasterio.open(folder / "image.tif", "r+") as file:
        coefficients = {name: [float(part) for part in str(value).split()] for name, value in values.items()}
        file.rpcs = RPC(**{name: part if "coeff" in name else part[0] for name, part in coefficients.items()})
    model = "".join(f'<MDI key="{name.upper()}">{value}</MDI>' for name, value in values.items())
    heights = f"<DEMPath>heights.tif</DEMPath><Metadata>{model}</Metadata>"
    (folder / "warped.vrt").write_text(
        WARPED.format(f"<SrcRPCTransformer><RPCTransformer>{heights}</RPCTransformer></SrcRPCTransformer>")
    )
    assert set(other_files(str(folder / "warped.vrt"))) == {str(folder / "image.tif"), "heights.tif"}


REFUSED = {
    "raw": (
        f'<VRTDataset rasterXSize="{SIZE}" rasterYSize="{SIZE}"><VRTRasterBand dataType="Byte" band="1" '
        'subclass="vrtrawrasterband"><SourceFilename relativeToVRT="1">mask.tif</SourceFilename></VRTRasterBand>'
        "</VRTDataset>",
        "has a VRTRawRasterBand",
    ),
    "processed": (
        '<VRTDataset subClass="VRTProcessedDataset"><Input><SourceFilename relativeToVRT="1">mask.tif</SourceFilename>'
        "</Input><ProcessingSteps><Step><Algorithm>BandAffineCombination</Algorithm><Argument "
        'name="coefficients_1">0,1</Argument></Step></ProcessingSteps></VRTDataset>',
        "has a VRTProcessedDataset",
    ),
    "another folder": (
        virtual((1, "image.tif")).replace(
            "<SourceBand>", '<OpenOptions><OOI key="ROOT_PATH">elsewhere</OOI></OpenOptions><SourceBand>'
        ),
        "has sources relative to elsewhere",
    ),
    "a subdataset beside it": (
        virtual((1, "image.tif"), SOURCE.format(1, "GTIFF_DIR:1:mask.tif")),
        r"GTIFF_DIR:1:mask.tif, a source of .*image.vrt, cannot be read",
    ),
    "a lost mask": (
        virtual((1, "image.tif"), SOURCE.format(1, "gone.tif")),
        r"gone.tif, a source of .*image.vrt, cannot be read",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_other_files__refuse_what_they_could_not_name(folder, kind):
    text, problem = REFUSED[kind]
    (folder / "image.vrt").write_text(text)
    with pytest.raises(InputError, match=problem):
        other_files(str(folder / "image.vrt"))


@pytest.mark.parametrize("is_zipped", [False, True])
def test_other_files__are_the_positions_that_a_warped_raster_names(folder, is_zipped):
    steps = 0.0125 * np.arange(SIZE)
    for name, values in (("x.tif", 5.4 + steps), ("y.tif", 43.6 - steps[:, np.newaxis])):
        write(folder / name, "float64")
        with rasterio.open(folder / name, "r+") as file:
            file.write(np.broadcast_to(values, (1, SIZE, SIZE)))
    names = [zipped(folder, name, f"{name}.tif") if is_zipped else str(folder / f"{name}.tif") for name in "xy"]
    metadata = "".join(
        f'<MDI key="{key}_{"dataset" if is_zipped else "DATASET"}">{name}</MDI><MDI key="{key}_BAND">1</MDI>'
        for key, name in zip("XY", names, strict=True)
    )
    offsets = {
        "PIXEL_OFFSET": 0,
        "LINE_OFFSET": 0,
        "PIXEL_STEP": 1,
        "LINE_STEP": 1,
        "SRS": CRS.from_epsg(4326).to_wkt(),
    }
    metadata += "".join(f'<MDI key="{key}">{value}</MDI>' for key, value in offsets.items())
    transformer = f"<GeoLocTransformer><Reversed>0</Reversed><Metadata>{metadata}</Metadata></GeoLocTransformer>"
    (folder / "warped.vrt").write_text(WARPED.format(f"<SrcGeoLocTransformer>{transformer}</SrcGeoLocTransformer>"))
    assert set(other_files(str(folder / "warped.vrt"))) == {str(folder / "image.tif"), *names}


@pytest.mark.parametrize("is_relative", [False, True])
def test_other_files__of_a_name_of_a_virtual_raster_have_this_one_and_its_sources(folder, monkeypatch, is_relative):
    monkeypatch.chdir(folder.parent)
    (folder / "image.vrt").write_text(virtual((1, "image.tif")))
    place = folder.name if is_relative else str(folder)
    assert other_files(f"vrt://{place}/image.vrt?bands=1") == [f"{place}/image.tif", f"{place}/image.vrt"]


def test_other_files__are_the_source_of_a_warped_raster_behind_a_link(folder):
    """GDAL writes the source of a warped raster relative to the link, not to its target."""
    (folder / "below").mkdir()
    write(folder / "below" / "image.tif")
    (folder / "below" / "warped.vrt").write_text(WARPED.format(f"<SrcGeoTransform>{GRID}</SrcGeoTransform>"))
    (folder / "warped.vrt").symlink_to("below/warped.vrt")
    assert other_files(str(folder / "warped.vrt")) == [str(folder / "below" / "image.tif")]


def test_other_files__below_a_linked_folder_are_named_once(folder):
    (folder / "image.vrt").write_text(virtual((1, "image.tif"), SOURCE.format(1, "mask.tif")))
    link = folder.with_name(f"{folder.name}-linked")
    link.symlink_to(folder)
    assert other_files(str(link / "image.vrt")) == [str(link / "image.tif"), str(link / "mask.tif")]


def test_other_files__of_a_text_are_found_from_the_working_directory(folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert other_files(virtual((1, "image.tif"), SOURCE.format(1, "mask.tif"))) == ["image.tif", "mask.tif"]


HISTORY = (
    '<Metadata><MDI key="ROOT_PATH">/elsewhere</MDI></Metadata>'
    '<Metadata domain="xml:HISTORY" format="xml"><SourceDataset>gone.tif</SourceDataset></Metadata>'
)


@pytest.mark.parametrize("parent", ["VRTDataset", "VRTRasterBand"])
def test_other_files__are_not_those_that_metadata_mention(folder, parent):
    text = re.sub(f"(<{parent}[^>]*>)", rf"\1{HISTORY}", virtual((1, "image.tif")), count=1)
    (folder / "image.vrt").write_text(text)
    assert other_files(str(folder / "image.vrt")) == [str(folder / "image.tif")]


def test_open_image__names_a_virtual_raster_with_metadata_that_are_not_xml(folder):
    history = '<Metadata domain="xml:HISTORY" format="xml"><its:history/></Metadata><VRTRasterBand'
    (folder / "image.vrt").write_text(virtual((1, "image.tif")).replace("<VRTRasterBand", history))
    with pytest.raises(InputError, match=r"image\.vrt has metadata that are not XML \(.*\): convert it with gdal_tr"):
        open_image(folder / "image.vrt")


@pytest.mark.parametrize(("size", "is_other"), [(SIZE, False), (SIZE // 2, True), (None, True)])
def test_survey__says_whether_overviews_of_sources_are_read(folder, size, is_other):
    parts = f'<SrcRect xSize="{size}" ySize="{SIZE}"/><DstRect xSize="{SIZE}.0" ySize="{SIZE}"/>' if size else ""
    parts = f"<SourceBand>1</SourceBand>{parts}"
    (folder / "inner.vrt").write_text(virtual((1, "image.tif")).replace("<SourceBand>1</SourceBand>", parts))
    outer = virtual((0, "vrt://inner.vrt")).replace(
        "<SourceBand>1</SourceBand>", parts.replace(str(SIZE // 2), str(SIZE))
    )
    (folder / "outer.vrt").write_text(outer.replace("inner.vrt", str(folder / "inner.vrt")))
    assert [survey(str(folder / name)).uses_overviews for name in ("inner.vrt", "outer.vrt")] == [is_other, is_other]
    assert not survey(str(folder / "image.tif")).uses_overviews


LEVEL = '<OpenOptions><OOI key="{}">0</OOI></OpenOptions>'
RECTANGLES = f'<SrcRect xSize="{SIZE}" ySize="{SIZE}"/><DstRect xSize="{SIZE}" ySize="{SIZE}"/>'
WITHOUT_LEVEL = virtual((1, "image.tif")).replace("</SimpleSource>", f"{RECTANGLES}</SimpleSource>")
WARPED_WITHOUT_LEVEL = WARPED.format(f"<SrcGeoTransform>{GRID}</SrcGeoTransform>")
READ = {
    "a.vrt": WITHOUT_LEVEL.replace("<SourceBand>", LEVEL.format("OVERVIEW_LEVEL") + "<SourceBand>"),
    "b.vrt": WITHOUT_LEVEL.replace("<SourceBand>", LEVEL.format("overview_level") + "<SourceBand>"),
    "warped.vrt": WARPED_WITHOUT_LEVEL.replace("<Transformer>", LEVEL.format("OVERVIEW_LEVEL") + "<Transformer>"),
    **dict.fromkeys(["vrt://image.tif?ovr=0", "vrt://image.tif?oo=OVERVIEW_LEVEL=0", "vrt://image.tif?outsize=8,8"]),
}
NOT_READ = {"image.tif": None}


@pytest.mark.parametrize("is_read", [True, False])
def test_pixel_files__have_overviews_where_these_are_read(folder, monkeypatch, is_read):
    monkeypatch.chdir(folder)
    with rasterio.open("image.tif.ovr", "w", "GTiff", SIZE // 2, SIZE // 2, 1, dtype="uint16") as file:
        file.write(np.full((1, SIZE // 2, SIZE // 2), 7, "uint16"))
    for name, text in (READ if is_read else NOT_READ).items():
        if text:
            (folder / name).write_text(text)
        with rasterio.open(name) as file:
            assert np.any(file.read() == 7) == is_read, name
        assert any(file.endswith("image.tif.ovr") for file in pixel_files(name)) == is_read, name
        assert survey(name).uses_overviews == is_read, name
    assert "image.tif.ovr" in pixel_files("GTIFF_DIR:1:image.tif.ovr")
    Path("both.vrt").write_text(virtual((1, "image.tif"), SOURCE.format(0, "GTIFF_DIR:1:image.tif.ovr")))
    assert any(file.endswith("image.tif.ovr") for file in pixel_files("both.vrt"))


def test_pixel_files__have_no_overviews_of_the_mask_in_capitals(folder):
    for name in ("image.tif.msk", "image.tif.MSK.OVR", "image.tif.OVR"):
        shutil.copy(folder / "mask.tif", folder / name)
    assert pixel_files(str(folder / "image.tif")) == [str(folder / name) for name in ("image.tif", "image.tif.msk")]


SCALED = virtual((1, "image.tif")).replace("SimpleSource", "ComplexSource")
EXPONENT = "<Exponent>0.5</Exponent><SrcMin>0</SrcMin>{}<DstMin>0</DstMin><DstMax>255</DstMax>"


@pytest.mark.parametrize("name", ["?scale=true", "?ot=Byte&SCALE_1=true", "?scale=1&exponent=0.5", "scaled.vrt"])
def test_pixel_files__refuse_a_raster_scaled_by_statistics(folder, monkeypatch, name):
    monkeypatch.chdir(folder)
    name = name if name == "scaled.vrt" else f"vrt://image.tif{name}"
    (folder / "scaled.vrt").write_text(SCALED.replace("</ComplexSource>", EXPONENT.format("") + "</ComplexSource>"))
    (folder / "outer.vrt").write_text(virtual((0, html.escape(name))))
    for refused in (name, "outer.vrt"):
        with pytest.raises(InputError, match=r"scaled by extremes that GDAL takes from .*: name the extremes"):
            pixel_files(refused)


def test_pixel_files__are_those_of_a_raster_scaled_by_numbers(folder, monkeypatch):
    monkeypatch.chdir(folder)
    with_numbers = EXPONENT.format("<SrcMax>9</SrcMax>")
    (folder / "scaled.vrt").write_text(SCALED.replace("</ComplexSource>", with_numbers + "</ComplexSource>"))
    for name in ("scaled.vrt", "vrt://image.tif?scale=0,9", "vrt://image.tif?ot=Byte&scale_1=0,9,0,255&exponent=0.5"):
        assert any(file.endswith("image.tif") for file in pixel_files(name)), name


@pytest.mark.parametrize("spelling", ['relativeToVRT="1"', "relativetovrt='01'"])
def test_other_files__refuse_a_source_that_is_a_text_with_relative_names(folder, monkeypatch, spelling):
    """GDAL finds them in the folder of the file that has the text, which other files do not tell."""
    monkeypatch.chdir(folder.parent)
    text = html.escape(virtual((1, "image.tif")).replace('relativeToVRT="1"', spelling))
    (folder / "outer.vrt").write_text(virtual((0, text)))
    with pytest.raises(InputError, match=r"outer\.vrt has a source that is a text with relative names: write that to"):
        other_files(f"{folder.name}/outer.vrt")


@pytest.mark.parametrize(
    "name", ["/vsizip//vsicurl/http://127.0.0.1:1/all.zip/mask.tif", "/vsicurl_streaming/http://h/m"]
)
def test_other_files__refuse_masks_of_which_a_change_would_not_be_noticed(folder, name):
    (folder / "image.vrt").write_text(virtual((1, "image.tif"), SOURCE.format(0, name)))
    with pytest.raises(InputError, match=r"of which a change would not be noticed|from files that GDAL does not list"):
        other_files(str(folder / "image.vrt"))

"""What the files of a run say of themselves, from the tables of `sat_intervals.products`."""

from dataclasses import dataclass

from rasterio.io import DatasetWriter

from sat_intervals.products import BANDS, FLAGS, INVALID


@dataclass(frozen=True)
class File:
    """What is particular to a file of a run."""

    name: str
    count: int
    dtype: str
    nodata: float | None

    def describe(self, dataset: DatasetWriter) -> None:
        """Give the bands their names, units and meanings."""
        if self is INTERVALS:
            for index, band in enumerate(BANDS, start=1):
                dataset.set_band_description(index, band.name)
                dataset.update_tags(index, meaning=band.meaning)
                if band.unit:
                    dataset.set_band_unit(index, band.unit)
        else:
            dataset.set_band_description(1, "validity")
            dataset.update_tags(1, **_flag_tags())


INTERVALS = File("intervals.tif", len(BANDS), "float32", float("nan"))
VALIDITY = File("validity.tif", 1, "uint16", None)


def _flag_tags() -> dict[str, str]:
    """The meaning of every bit, such as ``bit_08 = occlusion (invalid): rejected by cross-checking: occlusion``."""
    bits = {
        f"bit_{flag.bit:02}": f"{flag.name}{' (invalid)' if flag.invalid else ''}: {flag.meaning}" for flag in FLAGS
    }
    return {"meaning": f"sum of bits; a pixel is valid where (validity & {INVALID}) == 0", **bits}

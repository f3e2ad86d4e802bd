"""Options shared by the commands that take images: two or many, masks, no-data values, bands, the region to match."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from sat_intervals.cli.options import NAME, expert_option, gathered

if TYPE_CHECKING:
    from sat_intervals.raster import Image
    from sat_intervals.tiling import Window


@dataclass(frozen=True)
class PairArguments:
    """Two images, their masks, no-data values and bands, the region of the left one to match, and ``more`` images."""

    left: str
    right: str
    left_mask: str | None
    right_mask: str | None
    nodata: tuple[float, float] | None
    band: tuple[int, int] | None
    region: tuple[int, int, int, int] | None = None
    more: tuple[str, ...] = ()

    @property
    def window(self) -> "Window | None":
        """Return the region to match, None for all."""
        from sat_intervals.tiling import Window

        return Window(*self.region) if self.region else None

    def open(self) -> "list[Image]":
        """Open all images; what was given for one side goes with two images only."""
        from sat_intervals.errors import check_absent
        from sat_intervals.raster import open_image

        nodata, band = self.nodata or (None, None), self.band or (None, None)
        masks = self.left_mask, self.right_mask
        if self.more:
            two: dict[str, Any] = {"--left-mask": masks[0], "--right-mask": masks[1]}
            two["--nodata LEFT,RIGHT"], two["--band LEFT,RIGHT"] = (
                None if both[0] == both[1] else both for both in (nodata, band)
            )
            check_absent(two, "two images")
        names, sides = (self.left, self.right, *self.more), (0, 1, *[0] * len(self.more))
        return [
            open_image(name, band=band[side], nodata=nodata[side], mask=masks[side])
            for name, side in zip(names, sides, strict=True)
        ]


class _Both(click.ParamType):  # type: ignore[type-arg,unused-ignore]
    """A number for both images, or two, LEFT,RIGHT."""

    def __init__(self, kind: type[float]) -> None:
        self.name, self._kind = kind.__name__, kind

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        try:
            left, *right = map(self._kind, str(value).split(","))
            (right_or_left,) = right or (left,)
        except ValueError:
            self.fail(f"{value!r} is neither a number nor two, LEFT,RIGHT", parameter, context)
        return left, right_or_left


_IMAGE_OPTIONS = (
    click.option("--left-mask", type=NAME, help="Mask of the left image: non-zero = masked."),
    click.option("--right-mask", type=NAME, help="Mask of the right image."),
    click.option(
        "--nodata",
        type=_Both(float),
        metavar="V",
        help="No-data value of both images, or LEFT,RIGHT; replaces that of the files.",
    ),
    expert_option("--band", type=_Both(int), metavar="N", help="Band to match in the images, or LEFT,RIGHT."),
)
_PAIR = click.argument("left", type=NAME), click.argument("right", type=NAME)
_IMAGES = click.argument("images", metavar="LEFT RIGHT [MORE...]", nargs=-1, required=True, type=NAME)
_WINDOW = click.option(
    "--window", "region", type=int, nargs=4, metavar="ROW COL HEIGHT WIDTH", help="Region of the left image to match."
)


def _of_many(*, images: tuple[str, ...], **given: Any) -> PairArguments:
    """Return the first two images as a pair, with the others beside it."""
    if len(images) < 2:
        raise click.UsageError("give two images or more.")
    return PairArguments(images[0], images[1], **given, more=images[2:])


# The command gets ``pair``, a `PairArguments`: of two images, with the region to match, or of more.
image_options = gathered("pair", PairArguments, *_PAIR, *_IMAGE_OPTIONS)
pair_options = gathered("pair", PairArguments, *_PAIR, *_IMAGE_OPTIONS, _WINDOW)
many_options = gathered("pair", _of_many, _IMAGES, *_IMAGE_OPTIONS, _WINDOW)

# The command gets ``ground``: arguments of `surface`.
ground_options = gathered(
    "ground",
    dict,
    expert_option(
        "--extent",
        type=float,
        nargs=4,
        metavar="LEFT BOTTOM RIGHT TOP",
        help="Three images or more: part of the map that the surface covers, metres; default: what two images see.",
    ),
    click.option(
        "--heights",
        type=float,
        nargs=2,
        metavar="MIN MAX",
        help="Three images or more: heights of the ground, metres; default: found from the images.",
    ),
)

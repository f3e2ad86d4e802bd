"""Prepare pairs with workers: what `prepare` calls for each block runs on them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from sat_intervals.errors import RunError
from sat_intervals.progress import Progress
from sat_intervals.run.workers import Task, Workers, picklable_errors, reason, results

_RETRIES = 2


@dataclass(frozen=True)
class EachOnWorkers:
    """Calls functions on workers, a bounded number at a time; a `prepare.pair.Each`."""

    workers: Workers
    progress: Progress

    def __call__(
        self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], stage: str
    ) -> Iterator[tuple[int, Any]]:
        """Yield results with the number of their arguments, as they come."""
        tasks = (Task(i, _called, (function, each), _RETRIES) for i, each in enumerate(arguments))

        def failed(_: int, error: BaseException) -> NoReturn:
            raise RunError(f"{_FOUND[stage]} could not be found: {reason(error)}") from error

        self.progress(stage, 0, len(arguments))
        return results(self.workers, tasks, failed, lambda done: self.progress(stage, done, len(arguments)))


_FOUND = {"range": "the search range", "rows": "row offsets", "images": "mean and deviation of the images"} | {
    "heights": "the heights of the ground",
    "shifts": "the shifts of the images",
}


def _called(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    with picklable_errors():
        return function(*arguments)

"""Check limits and environment variables before the libraries start."""

import os
import resource

# Bytes of address space that the libraries need at start; with less they abort or hang.
_ADDRESSES = 15 * 10**8


def check_process() -> None:
    """Raise if the libraries would abort at import.

    Raises
    ------
    SatIntervalsError
        Gives the current and the needed value.
    """
    from sat_intervals.errors import SatIntervalsError

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < _ADDRESSES:
        raise SatIntervalsError(
            f"the address space is limited to {limit / 1e9:.1f} GB, at least {_ADDRESSES / 1e9:.1f} GB are needed: "
            "raise ulimit -v"
        )
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        raise SatIntervalsError("NUMBA_DISABLE_JIT is set, but the kernels need numba's compiler: unset it")
    threads = os.environ.get("NUMBA_NUM_THREADS", "1")
    if not threads.isdecimal() or int(threads) < 1:
        raise SatIntervalsError(f"NUMBA_NUM_THREADS is {threads!r}: set it to a number above 0, or not at all")

"""Where a suite's flights are flown: some at a time on this machine, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from typing import TYPE_CHECKING, Final

from companion.sim.suite import Ending, Endings, PlannedFlight, SuiteError
from companion.sim.suite_process import TIME_LIMIT_S, FlightProcesses

if TYPE_CHECKING:
    from distributed import Client

Fly = Callable[[PlannedFlight], Ending]

_CONNECT_S: Final = 10.0


def fly_locally(flights: Sequence[PlannedFlight], *, jobs: int, processes: FlightProcesses) -> Endings:
    """Fly on this machine.

    Parameters
    ----------
    flights
        Which.
    jobs
        How many at a time.
    processes
        Flies one; stopped when the generator is closed early.
    """
    if jobs < 1:
        raise SuiteError(f"jobs: found {jobs}; allowed: 1 or more")
    with ThreadPoolExecutor(jobs, thread_name_prefix="flight") as pool:
        waiting: dict[Future[Ending], PlannedFlight] = {
            pool.submit(processes.fly, flight): flight for flight in flights
        }
        try:
            for future in as_completed(waiting):
                # A suite keeps thousands of flights' files on disk, not in memory.
                yield waiting.pop(future), future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            if waiting:
                processes.stop()


def fly_on_cluster(flights: Sequence[PlannedFlight], *, scheduler: str, fly: Fly | None = None) -> Endings:
    """Fly on the workers of a Dask cluster, as many at a time as they have threads.

    The workers need this package with its ``sim`` and ``cluster`` extras in the same version, and share no disk with us. When the generator is closed early,
    flights that have not begun are cancelled; those in the air end by themselves.

    Parameters
    ----------
    flights
        Which.
    scheduler
        Address, such as ``tcp://10.0.0.5:8786``.
    fly
        Flies one, on a worker; by default ``fly_in_process``.

    Raises
    ------
    SuiteError
        When ``distributed`` is not installed, or nothing answers at that address.
    """
    client = _connected(scheduler)
    from distributed import as_completed as completed_there

    try:
        # Impure: each flight has a key of its own, so that no other suite's result is taken for it.
        flying = client.map(fly if fly is not None else fly_in_process, flights, pure=False)
        flight_of = dict(zip((future.key for future in flying), flights, strict=True))
        completed = completed_there(flying, loop=client.loop)
        del flying  # the scheduler may forget each result as soon as it is here
        for future in completed:
            if future.cancelled():
                raise SuiteError(f"the Dask scheduler at {scheduler} was lost")
            error = future.exception()
            ending = future.result() if error is None else Ending(error=_one_line(error))
            yield flight_of[future.key], ending
    finally:
        client.close()


def fly_in_process(flight: PlannedFlight) -> Ending:
    """Fly one flight in a process of its own, wherever this is called."""
    return FlightProcesses(time_limit_s=TIME_LIMIT_S).fly(flight)


def _connected(scheduler: str) -> Client:
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise SuiteError(
            "a cluster needs the extra cluster: pip install 'void-companion[cluster]'"
        ) from error
    try:
        return Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SuiteError(f"no Dask scheduler answers at {scheduler}: {error}") from error


def _one_line(error: BaseException) -> str:
    return " ".join(f"the worker failed: {type(error).__name__}: {error}".split())

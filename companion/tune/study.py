"""The search itself: Optuna's, in a storage that several processes and machines may share."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.exceptions import OptunaError
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import MaxTrialsCallback, Study
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from companion.tune.cases import Cases
from companion.tune.errors import TrialError, TuneError
from companion.tune.space import Dimension, Settings, Value

_STORAGE_ERRORS: Final = (OptunaError, SQLAlchemyError, OSError, ValueError, KeyError)
"""Of a database, of a disk, and of a file that is no journal."""
_ABOUT: Final = "about"
_REASON: Final = "reason"
_SCORES: Final = "scores"
_MOST_FAILURES: Final = 10
_RANDOM_FIRST: Final = 10
_SCORE_DIGITS: Final = 12


def open_storage(where: str) -> BaseStorage:
    """Return the storage of searches.

    Parameters
    ----------
    where
        A database (``sqlite:///study.db``, ``postgresql://...``), or the path of a journal file, which may lie on a shared disk.

    Raises
    ------
    TuneError
        It cannot be used.
    """
    try:
        if "://" in where:
            return RDBStorage(
                where,
                engine_kwargs={"connect_args": {"timeout": 60}} if where.startswith("sqlite:") else None,
            )
        return JournalStorage(JournalFileBackend(where))
    except ImportError as error:
        raise TuneError(f"--storage {where}: the database's driver is not installed: {error}") from error
    except OSError as error:
        raise TuneError(f"--storage {where}: cannot be used: {error.strerror or error}") from error
    except _STORAGE_ERRORS as error:
        raise TuneError(f"--storage {where}: cannot be used: {_first_line(error)}") from error


def open_study(
    storage: BaseStorage, name: str, space: Sequence[Dimension], about: Mapping[str, Any], seed: int | None
) -> Study:
    """Return a search, begun or gone on with.

    Parameters
    ----------
    storage
        From :func:`open_storage`.
    name
        Of the search in it.
    space, about
        What is searched, on what. A search of that name must have had the same.
    seed
        Of the suggestions; None: each process and each run other ones.

    Raises
    ------
    TuneError
        The name has another search, or the storage fails.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    wanted = json.dumps({"space": [each.as_dict() for each in space], **about}, sort_keys=True)
    try:
        study = optuna.create_study(
            storage=storage, study_name=name, direction="maximize", load_if_exists=True
        )
        known = study.user_attrs.get(_ABOUT)
        if known is None:
            study.set_user_attr(_ABOUT, wanted)
            known = study.user_attrs.get(_ABOUT)  # another process may have been first, with another search
        tried = len(study.trials)
        if known == wanted and not tried:
            study.enqueue_trial({each.name: each.usual for each in space}, skip_if_exists=True)
    except _STORAGE_ERRORS as error:
        raise TuneError(f"--storage: cannot be used: {_first_line(error)}") from error
    if known != wanted:
        raise TuneError(
            f"--study {name}: that search in this storage is of other settings or cases; give another --study or --storage"
        )
    # Gone on with, the same seed must not give the same suggestions again.
    study.sampler = optuna.samplers.TPESampler(
        seed=None if seed is None else seed + tried, n_startup_trials=_RANDOM_FIRST, constant_liar=True
    )
    return study


def search(
    study: Study,
    space: Sequence[Dimension],
    cases: Cases,
    trials: int,
    *,
    on_case: Callable[[], None] = lambda: None,
    on_trial: Callable[[FrozenTrial], None] = lambda _: None,
) -> None:
    """Try settings until the search has so many finished trials, those of other processes and earlier runs included.

    The first trial has the usual settings. One that is interrupted is failed in the storage; what was finished stays.

    Raises
    ------
    TuneError
        The usual settings cannot be judged, or nothing can for many trials in a row.
    """
    if len(finished(study)) >= trials:
        return
    failures: list[str] = []

    def objective(trial: Trial) -> float:
        settings = suggested(trial, space)
        scores = cases.scores(settings, "searched", on_case)
        trial.set_user_attr(_SCORES, scores.tolist())
        return round(float(scores.mean()), _SCORE_DIGITS)

    def judged(trial: Trial) -> float:
        try:
            return objective(trial)
        except TrialError as error:
            trial.set_user_attr(_REASON, str(error))
            failures.append(str(error))
            raise

    def after(_: Study, trial: FrozenTrial) -> None:
        if trial.state == TrialState.COMPLETE:
            failures.clear()
        elif trial.number == 0 or len(failures) >= _MOST_FAILURES:
            which = "the usual settings" if trial.number == 0 else f"{len(failures)} trials in a row"
            raise TuneError(f"{which} cannot be judged: {failures[-1]}")
        on_trial(trial)

    study.optimize(
        judged,
        n_trials=None,
        catch=(TrialError,),
        callbacks=[after, MaxTrialsCallback(trials, states=(TrialState.COMPLETE,))],
    )


def suggested(trial: Trial, space: Sequence[Dimension]) -> dict[str, Value]:
    """Return the settings that a trial is to judge."""
    return {each.name: each.tidy(_suggested(trial, each)) for each in space}


def settings_of(trial: FrozenTrial, space: Sequence[Dimension]) -> Settings:
    """Return the settings that a trial had."""
    return {each.name: each.tidy(trial.params[each.name]) for each in space}


def finished(study: Study) -> list[FrozenTrial]:
    """Return the trials that have a value, in their order."""
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))


def scores_of(trial: FrozenTrial) -> NDArray[np.float64]:
    """Return what each case was worth in a trial that has a value, (N,)."""
    return np.array(trial.user_attrs[_SCORES], np.float64)


def importances(study: Study) -> dict[str, float]:
    """Return the share of each setting in the differences between trials (fANOVA), largest first; empty where they tell nothing."""
    trials = finished(study)
    if len(trials) < 3 or len({trial.value for trial in trials}) < 2:
        return {}
    found = optuna.importance.get_param_importances(
        study, evaluator=optuna.importance.FanovaImportanceEvaluator(seed=0)
    )
    return {name: float(share) for name, share in found.items()}


def _suggested(trial: Trial, each: Dimension) -> Value:
    if each.choices:
        return cast(Value, trial.suggest_categorical(each.name, list(each.choices)))
    if each.whole:
        return trial.suggest_int(each.name, int(each.low), int(each.high), step=each.step, log=each.is_log)
    return trial.suggest_float(each.name, each.low, each.high, log=each.is_log)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def default_storage(folder: Path) -> str:
    """Return where a search is kept that names no storage."""
    return str(folder / "study.journal")

"""LoopDetector: submaps go in one by one, loop closures come out."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from terrainloop.config import Settings
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.hyperparameters import fit_hyperparameters
from terrainloop.gp.kernel import Hyperparameters
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import LoopCandidate
from terrainloop.matching.mapped import MappedSubmap
from terrainloop.matching.register import compare
from terrainloop.submap import Submap


class LoopDetector:
    """Finds the earlier submaps that show the same place as a new one.

    Parameters
    ----------
    settings : Settings, optional
    parameters : Hyperparameters, optional
        Of the Gaussian process, where they are known; else fitted as ``settings.map.fit`` says.
    expected_pairs : int, optional
        That the mission will compare, where it is known: `max_false_loops` is shared out among them.
        Else each query is given less of it than the one before, so that it holds for any number.
    workers : int
        Threads; the result does not depend on it.

    Attributes
    ----------
    submaps : dict of str to MappedSubmap
        The database, by name, in the order of arrival.
    candidates : list of LoopCandidate
        Every pair that was compared.

    Examples
    --------
    >>> detector = LoopDetector()
    >>> for submap in load_mission("mission/"):  # doctest: +SKIP
    ...     for loop in detector.add(submap):
    ...         print(loop.target, loop.source, loop.T_target_source)
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        parameters: Hyperparameters | None = None,
        expected_pairs: int | None = None,
        workers: int = 1,
    ) -> None:
        self.settings = settings or Settings()
        self.parameters = parameters
        self.expected_pairs = expected_pairs
        self.workers = workers
        self.submaps: dict[str, MappedSubmap] = {}
        self.candidates: list[LoopCandidate] = []

    def add(self, submap: Submap) -> list[LoopCandidate]:
        """Map a submap, compare it with the earlier ones, store it.

        Parameters
        ----------
        submap : Submap
            Named unlike any before.

        Returns
        -------
        list of LoopCandidate
            The accepted loops; `candidates` holds the rejected pairs too.

        Raises
        ------
        TerrainLoopError
            If the name is taken or no map can be made; the database is then as it was.
        """
        self._check_name(submap.name)
        parameters = self.parameters
        if parameters is None and self.settings.map.fit == "database":
            parameters = fit_database([submap], self.settings, workers=self.workers)
        query = map_submap(submap, self.settings, parameters, workers=self.workers)
        self.parameters = parameters
        return self.add_mapped(query)

    def add_mapped(self, query: MappedSubmap) -> list[LoopCandidate]:
        """As `add`, for a submap that is mapped already (see `map_submap`)."""
        self._check_name(query.name)
        stored = list(self.submaps.values())[: max(0, len(self.submaps) - self.settings.skip_recent)]
        # A mission may go on for ever: its k-th query, which finds k stored, may spend 1 / (k (k + 1)) of
        # `max_false_loops`, all queries together 1.
        pairs = self.expected_pairs or len(stored) ** 2 * (len(stored) + 1)
        work = partial(compare, query, settings=self.settings, pairs=pairs)
        with ThreadPoolExecutor(self.workers) as pool:
            candidates = list(pool.map(work, stored))
        self.submaps[query.name] = query
        self.candidates += candidates
        return [candidate for candidate in candidates if candidate]

    def _check_name(self, name: str) -> None:
        if name in self.submaps:
            raise TerrainLoopError(
                expected="a submap with a name of its own",
                found=f"a second {name!r}",
                mend="name each submap differently",
            )


def fit_database(submaps: Sequence[Submap], settings: Settings, *, workers: int = 1) -> Hyperparameters:
    """Hyperparameters for all maps of a database, so that they are comparable."""
    limits = [n for n in (settings.map.max_points, settings.map.fit_points) if n is not None]
    return fit_hyperparameters(
        submaps,
        length_scale=settings.map.length_scale,
        noise=settings.map.noise,
        max_points=min(limits, default=None),
        exact=settings.map.solver == "exact",
        remove_plane=settings.map.remove_plane,
        seed=settings.seed,
        workers=workers,
    )


def map_submap(
    submap: Submap, settings: Settings, parameters: Hyperparameters | None = None, *, workers: int = 1
) -> MappedSubmap:
    """The gradient map of a submap and its keypoints.

    Parameters
    ----------
    submap : Submap
    settings : Settings
    parameters : Hyperparameters, optional
        Of the database; without them they are fitted to this submap.
    workers : int
        Threads; the result does not depend on it.
    """
    parameters = parameters or fit_database([submap], settings, workers=workers)
    gradient_map = GradientMap.from_points(
        submap,
        parameters.length_scale,
        parameters.variance,
        parameters.noise,
        settings.map.resolution,
        max_points=settings.map.max_points,
        remove_plane=settings.map.remove_plane,
        local_noise=settings.map.local_noise,
        solver=settings.map.solver,
        max_variance_ratio=settings.map.max_variance_ratio,
        seed=settings.seed,
        workers=workers,
    )
    return MappedSubmap.of(submap.name, gradient_map, settings)

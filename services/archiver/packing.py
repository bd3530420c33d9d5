"""Packs finished sections densely while there is nothing else to do; they take the files' places when the run ends."""

from vtslam.common.settings import StorageSettings
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.run_folder import WRITTEN_CODEC, RunFolder
from vtslam.storage.section_care import pack_ahead


class Packing:
    """The sections of a run that are to be packed ahead of its end, in order.

    Args:
        run: The run folder, open for writing.
        settings: In which codec.
    """

    def __init__(self, run: RunFolder, settings: StorageSettings) -> None:
        self._run, self._codec = run, settings.codec
        self._grid = DenseGrid().coarser(settings.coarseness)
        self._next = 0

    def step(self, num_durable: int) -> bool:
        """Pack the next of the first ``num_durable`` sections; false if there is none left. Raises StorageError."""
        if self._codec == WRITTEN_CODEC:
            return False
        while self._next < num_durable and self._run.packed_path(self._next).exists():
            self._next += 1
        if self._next >= num_durable:
            return False
        pack_ahead(self._run, self._next, codec=self._codec, grid=self._grid)
        return True

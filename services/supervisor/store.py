"""The map store of a fleet, as all its processes open it."""

from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.settings import Settings
from vtslam.common.shm.map_store import MapStore


def map_store(folder: FleetFolder, settings: Settings) -> MapStore:
    """The fleet's map store, within the budget of the settings."""
    return MapStore(folder.map_path, budget_bytes=settings.fleet.map_budget_mb * 10**6)

"""map_server: the map, for everybody who needs it, however late they come."""

from __future__ import annotations

import os
from pathlib import Path

from nav_msgs.msg import OccupancyGrid

from navigation_stack import managed, maps
from navigation_stack.grid import Grid


def generated(seed: int) -> Grid:
    """The map of the world of a seed."""
    from navigation_world import generate

    found = generate(seed).map
    return Grid(found.cells, found.grid.resolution, found.grid.left, found.grid.bottom)


class MapServer(managed.Managed):
    """Publishes /map.

    Parameters: yaml_filename (a map's file; empty: the map of the world of NAVIGATION_SEED), topic_name, frame_id.
    """

    def __init__(self) -> None:
        super().__init__("map_server")
        self.parameter("yaml_filename", os.environ.get("NAVIGATION_MAP", ""))
        self._message: OccupancyGrid | None = None

    def configured(self) -> None:
        file = self.parameter("yaml_filename", "")
        grid = maps.read(Path(file)) if file else generated(int(os.environ.get("NAVIGATION_SEED", "7")))
        message = OccupancyGrid()
        message.header.frame_id = self.parameter("frame_id", "map")
        message.info.resolution = grid.resolution
        message.info.height, message.info.width = grid.cells.shape
        message.info.origin.position.x, message.info.origin.position.y = grid.x, grid.y
        message.info.origin.orientation.w = 1.0
        message.data.frombytes(grid.cells.tobytes())
        self._message = message
        self._map = self.create_lifecycle_publisher(
            OccupancyGrid, self.parameter("topic_name", "/map"), managed.LATCHED
        )
        self.at_cleanup(lambda: self.destroy_lifecycle_publisher(self._map))

    def activated(self) -> None:
        assert self._message is not None
        self._message.header.stamp = self._message.info.map_load_time = self.get_clock().now().to_msg()
        self._map.publish(self._message)

    def cleaned(self) -> None:
        self._message = None


if __name__ == "__main__":
    managed.run(MapServer)

"""How the parts are arranged."""

import rerun.blueprint as rrb

from vtslam.services.viewer import names


def blueprint(*, is_live: bool) -> rrb.Blueprint:
    """The map and its sections on the left, the newest frame on the right, curves below.

    Memory and what was dropped are known of a running fleet only.
    """
    space = rrb.Vertical(
        rrb.Spatial3DView(origin=names.WORLD, contents=[f"{names.WORLD}/**"], name="map, camera, path"),
        rrb.Spatial3DView(
            origin=names.STATES,
            contents=[f"{names.STATES}/**"],
            name="sections: orange active, blue in memory, grey on disk",
        ),
        row_shares=[2, 1],
    )
    pictures = rrb.Grid(
        rrb.Spatial2DView(origin=names.CAMERA, contents=[names.INPUT], name="input"),
        rrb.Spatial2DView(origin=names.RENDERED, name="rendered from the map"),
        rrb.Spatial2DView(origin=names.RESIDUAL, name="residual x5"),
        rrb.Spatial2DView(origin=names.DEPTH, name="depth"),
        grid_columns=2,
    )
    plots = [
        rrb.TimeSeriesView(origin=f"{names.FIGURES}/{name}", name=title, plot_legend=rrb.PlotLegend(visible=True))
        for name, title in names.PLOTS.items()
        if is_live or name not in names.LIVE_PLOTS
    ]
    words = rrb.TextLogView(origin=names.EVENTS, name="events")
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(space, pictures, column_shares=[1, 1]),
            rrb.Grid(*plots, words, grid_columns=4 if is_live else 3),
            row_shares=[3, 2],
        ),
        collapse_panels=True,
    )

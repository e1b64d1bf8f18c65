"""Pictures of few dots, where it counts that they are drawn, not how they look or fit."""


def sketch(patch):
    """Let figures be drawn so until the patch is undone."""
    from matplotlib.figure import Figure

    finer = Figure.set_dpi

    def coarser(figure, dpi):
        figure.set_layout_engine("none")  # takes longer than the drawing
        finer(figure, min(dpi, 25))

    patch.setattr(Figure, "set_dpi", coarser)

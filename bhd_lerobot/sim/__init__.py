"""MuJoCo, which no other package imports."""

__all__ = [
    "backdrop",
    "camera",
    "chain",
    "description",
    "efforts",
    "engine",
    "files",
    "frames",
    "lidar",
    "plant",
    "render_thread",
    "scene",
    "table_stage",
    "tabletop",
    "window",
    "world",
]

"""Pillow, or one sentence that says how to install it."""

from ..models.errors import require

require("PIL", "render", "what is written on pictures and into films")

from PIL import Image, ImageColor, ImageDraw, ImageFont  # noqa: E402

__all__ = ["Image", "ImageColor", "ImageDraw", "ImageFont"]

"""The devices for Bluesky plans, under the name by which plans import them."""

from ldcnd.lab.bluesky import *  # noqa: F403

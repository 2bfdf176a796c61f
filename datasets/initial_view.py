"""Episode and step at which a data set is displayed first."""

from weakref import WeakKeyDictionary

import numpy as np

from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode, is_image, lost_images

BEFORE, DURING = 3, 5
"""Steps of the first contact with images before the outage, and in it."""

SEARCHED = 100
"""Largest number of episodes that are searched."""

_moments: WeakKeyDictionary[Dataset, tuple[int, int]] = WeakKeyDictionary()


def initial_view(data: Dataset) -> tuple[int, int]:
    """Episode and step to display first: of a data set with outages, where an outage begins in the first contact.

    It is the first held-out episode whose first contact has images for at least ``BEFORE`` steps and then, still in
    contact, none for at least ``DURING`` steps; and its last step with an image. There, both modalities observe the
    object, and in the next step the information share passes from image to haptics. Otherwise: the start of the first
    held-out episode.
    """
    if data not in _moments:
        _moments[data] = _search(data)
    return _moments[data]


def _search(data: Dataset) -> tuple[int, int]:
    held_out = data.held_out()
    if "outages" in data[held_out[0]].provenance.get("ingredients", {}):
        for index in held_out[:SEARCHED]:
            if (step := outage_in_first_contact(data[index])) is not None:
                return index, step
    return held_out[0], 0


def outage_in_first_contact(episode: Episode) -> int | None:
    """Last step with an image before an outage that begins in the first contact, or None."""
    contact = episode.contact.astype(bool)
    black = np.any([lost_images(images) for images in episode.observations.values() if is_image(images)], axis=0)
    first = int(contact.argmax())
    last = first + int(np.append(~contact[first:], True).argmax())  # first step after the contact
    begin = first + int(np.append(black[first:last], True).argmax())
    if begin - first < BEFORE or last - begin < DURING or not black[begin : begin + DURING].all():
        return None
    return begin - 1

"""Batches of filmed motion, some with their truth and some without: :class:`TracksDataModule`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor

from kcs_torch.errors import OptionError, unknown
from kcs_torch.io.load import check_reading
from kcs_torch.methods import METHODS, Method
from kcs_torch.skeleton import Skeleton
from kcs_torch.training.batch import Batch
from kcs_torch.training.clips import SYNTHETIC, Clip, file_clips, find_files, synthetic_clips
from kcs_torch.training.detections import DetectedWindows
from kcs_torch.training.loader import BatchLoader, Deck
from kcs_torch.training.options import AMOUNT, COUNT, COUNT_OR_NONE, POSITIVE, SHARE, WHOLE, Rule, check_options
from kcs_torch.training.pseudo import pseudo_labels
from kcs_torch.training.seeds import generator_of
from kcs_torch.training.windows import FilmedWindows

__all__ = ["TracksDataModule"]

Patterns = str | Path | Sequence[str | Path]
RATE_OR_NONE: Rule = float | None, lambda x: x is None or 0 < x < math.inf, "a positive number or None"
TILTS = "two angles within -90..90 degrees, the smaller one first"


class TracksDataModule(lightning.LightningDataModule):
    """Windows of 3D motion, filmed by random cameras; a chosen share of them shows its truth.

    A batch depends on the seed, the epoch and its number in it, and on nothing else: training that is resumed from a
    checkpoint sees what it would have seen. By default the data set is finite: each clip has ``views`` cameras, and
    their tracks with their noise and hidden joints stay the same. Which frames show their truth is drawn for all views
    together, and those of a smaller share are among those of a greater one.

    Args:
        train: files of 3D motion (any that :func:`kcs_torch.load_motion` reads), a pattern such as ``cmu/*.npz``, or
            several; those that begin with ``!`` are left out. Or "synthetic": motion that is made up.
        val: files for validation, as of ``train``.
        test: files for the test, as of ``train``. With synthetic motion for training and nothing named here, validation
            and test have synthetic motion of their own.
        tracks: files of 2D tracks to train on as well, which have no truth: any that :func:`kcs_torch.load_tracks`
            reads, the most seen person of each, as patterns; a folder that one matches is a clip. Joints are matched by
            name, and a third of them may be missing. Windows with half of the joints seen in every frame stand among
            those without truth, and serve losses that need none.
        reading: options of :func:`kcs_torch.load_tracks` for ``tracks``: MediaPipe's files may need ``image_size``,
            VideoPose3D's ``trust``.
        folder: that patterns are relative to.
        skeleton: whose joints are found by name in every file; that of the first file if None ("h36m17" of synthetic
            motion).
        up: the axis that points up in those files that do not say; y if None.
        units: of the tracks: mm, cm or m.
        file_units: of those files that do not say (BVH); others keep their own.
        file_fps: frames per second of those files of motion that do not say (ASF/AMC).
        fps: frames per second that all motion is brought to; None takes it as it is. 2D tracks that do not
            say theirs are taken as they are.
        window: frames of a window.
        stride: frames from one training window to the next; ``window`` if None.
        views: cameras of each clip.
        pitch: degrees by which cameras look down, least and most.
        noise: standard deviation of the tracks, in ``units``.
        occlusion: expected share of hidden joints, half of them for single frames, half for ten.
        fresh_cameras: draw cameras, noise and hidden joints anew for every window of every training batch. A labelled
            window then shows its truth from every side.
        batch_size: windows.
        steps_per_epoch: batches of an epoch; as many as show every window about once if None.
        labelled: share of the training windows' frames that show their truth, at most, but one window of frames at
            least. A window is labelled where all of its frames show it; the others use none of it.
        labelled_per_batch: share of a batch that is taken from these, where there are others.
        unlabelled: False leaves out those without truth: the same steps on labelled windows, and on ``tracks``, only.
        pseudo: a :class:`kcs_torch.Method` or its name, whose reconstructions are the labels of unlabelled windows.
        pseudo_trust: standard deviation of depth, as a share of the size of the body (root mean square of its tracks),
            at which a pseudo-label has half weight; used where the method tells its uncertainty.
        cache: folder to keep reconstructions in; they are made again each time if None.
        clips: of synthetic motion.
        seed: of everything.

    Raises:
        OptionError: an option is out of range.

    >>> data = TracksDataModule(clips=2, batch_size=4, labelled=0.25)
    >>> data.setup("fit")
    >>> batch = next(iter(data.train_dataloader()))
    >>> batch.tracks.shape, batch.labelled.tolist()
    (torch.Size([4, 27, 17, 2]), [1.0, 1.0, 0.0, 0.0])
    """

    def __init__(
        self,
        train: Patterns = SYNTHETIC,
        *,
        val: Patterns = (),
        test: Patterns = (),
        tracks: Patterns = (),
        reading: Mapping[str, Any] | None = None,
        folder: str | Path = ".",
        skeleton: str | Path | Skeleton | None = None,
        up: str | None = None,
        units: str = "mm",
        file_units: str | None = None,
        file_fps: float | None = None,
        fps: float | None = 30.0,
        window: int = 27,
        stride: int | None = None,
        views: int = 4,
        pitch: tuple[float, float] = (0.0, 20.0),
        noise: float = 0.0,
        occlusion: float = 0.0,
        fresh_cameras: bool = False,
        batch_size: int = 64,
        steps_per_epoch: int | None = None,
        labelled: float = 1.0,
        labelled_per_batch: float = 0.5,
        unlabelled: bool = True,
        pseudo: str | Method | None = None,
        pseudo_trust: float = 0.1,
        cache: str | Path | None = None,
        clips: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_options(
            "data",
            reading=(reading, (Mapping | None, lambda _: True, "options of load_tracks, by name, or None")),
            file_fps=(file_fps, RATE_OR_NONE),
            fps=(fps, RATE_OR_NONE),
            window=(window, COUNT),
            stride=(stride, COUNT_OR_NONE),
            views=(views, COUNT),
            pitch=(pitch, (tuple[float, float], lambda x: -90 <= x[0] <= x[1] <= 90, TILTS)),
            noise=(noise, AMOUNT),
            occlusion=(occlusion, (float, lambda x: 0 <= x < 1, "a share of at least 0 and below 1")),
            batch_size=(batch_size, COUNT),
            steps_per_epoch=(steps_per_epoch, COUNT_OR_NONE),
            labelled=(labelled, SHARE),
            labelled_per_batch=(labelled_per_batch, SHARE),
            pseudo=(pseudo, (str | Method | None, lambda _: True, "a method, its name or None")),
            pseudo_trust=(pseudo_trust, POSITIVE),
            clips=(clips, COUNT),
            seed=(seed, WHOLE),
        )
        others = bool(tracks) or (labelled < 1 and unlabelled)
        if batch_size == 1 and labelled > 0 and 0 < labelled_per_batch < 1 and others:
            raise OptionError("data: batch_size: expected at least 2, so that a batch has windows of both kinds, got 1")
        if labelled == 0 and not unlabelled and not tracks:
            raise OptionError("data: unlabelled: nothing is left to train on without labelled windows (labelled=0)")
        if isinstance(pseudo, str):
            if pseudo not in METHODS:
                raise unknown("method for pseudo", pseudo, METHODS)
            pseudo = METHODS[pseudo]()
        if pseudo is not None and fresh_cameras:
            raise OptionError("data: pseudo: reconstructions are of tracks that stay the same: not with fresh_cameras")
        self.files = {"train": train, "val": val, "test": test}
        check_reading(**reading or {})
        self.tracks, self.reading = tracks, dict(reading or {})
        self.folder, self.body, self.up, self.units, self.fps = folder, skeleton, up, units, fps
        self.file_units, self.file_fps = file_units, file_fps
        self.window, self.stride, self.views = window, stride or window, views
        self.pitch = float(pitch[0]), float(pitch[1])
        self.noise, self.occlusion, self.fresh_cameras = noise, occlusion, fresh_cameras
        self.batch_size, self.steps_per_epoch = batch_size, steps_per_epoch
        self.labelled, self.labelled_per_batch, self.unlabelled = labelled, labelled_per_batch, unlabelled
        self.pseudo, self.pseudo_trust, self.cache = pseudo, pseudo_trust, cache
        self.num_clips, self.seed = clips, seed
        self.sets: dict[str, FilmedWindows] = {}
        self.detected: DetectedWindows | None = None

    @property
    def skeleton(self) -> Skeleton:
        """Of all windows; reads the files where that has not been done."""
        return self._set("train").skeleton

    def prepare_data(self) -> None:
        """Fill the cache, where there is one, before several processes would."""
        if self.pseudo is not None and self.cache is not None:
            self.setup("fit")

    def setup(self, stage: str | None = None) -> None:
        """Read, cut and film what a stage needs ("fit", "validate", "test"; all if None).

        Raises:
            OptionError: no file matches a pattern, one that begins with ``!`` leaves out none, or a file is in two of
                train, val and test, or in ``tracks`` and val or test.
            FormatError: a file cannot be read as motion.
            SkeletonError: its joints do not fit.
            ShapeError: a clip is shorter than a window.
        """
        for split in {"fit": ("train", "val"), "validate": ("val",), "test": ("test",)}.get(
            stage or "", ("train", "val", "test")
        ):
            if split == "train" or self._named(split):
                self._set(split)
        if stage in (None, "fit"):
            self._detected()
        if stage in (None, "fit") and self.pseudo is not None and self.unlabelled and len(self.unlabelled_items):
            train = self._set("train")
            if train.pseudo_points is None:
                wanted = self.unlabelled_items
                pairs = torch.stack([train.clip_of[wanted // self.views], wanted % self.views], -1).unique(dim=0)
                train.pseudo_points, train.pseudo_weights = pseudo_labels(
                    train, pairs, self.pseudo, fps=self.fps, units=self.units, trust=self.pseudo_trust, cache=self.cache
                )

    @property
    def labelled_items(self) -> Tensor:
        """Training items with their truth, which the seed alone chooses."""
        return self._items(labelled=True)

    @property
    def unlabelled_items(self) -> Tensor:
        """Training items without truth."""
        return self._items(labelled=False)

    def train_dataloader(self) -> BatchLoader:
        """Mixed batches, labelled windows first."""
        items, detected = self._set("train"), self._detected()
        seen, blind = self.labelled_items, self.unlabelled_items
        blind = blind if self.unlabelled else blind[:0]
        count = len(items)
        if detected is not None:  # numbered after the filmed ones
            blind = torch.cat([blind, count + torch.arange(len(detected))])
            count += len(detected)
        share = 1.0 if not len(blind) else self.labelled_per_batch if len(seen) else 0.0
        first = round(share * self.batch_size)
        if len(seen) and len(blind) and self.batch_size > 1 and 0 < share < 1:
            first = min(max(first, 1), self.batch_size - 1)
        decks = [
            (Deck(seen, self.seed, "labelled"), first),
            (Deck(blind, self.seed, "unlabelled"), self.batch_size - first),
        ]
        mark = torch.arange(self.batch_size) < first
        steps = self.steps_per_epoch or math.ceil(count / self.batch_size)

        still = getattr(self.trainer, "overfit_batches", 0) > 0  # the same few batches, again and again

        def make(epoch: int, step: int) -> Batch:
            epoch = 0 if still else epoch
            number = epoch * steps + step
            drawn = torch.cat([deck.draw(number * size, size) for deck, size in decks])
            fresh = generator_of(self.seed, "fresh", epoch, step) if self.fresh_cameras else None
            filmed = drawn < len(items)
            if detected is None or bool(filmed.all()):
                return items.batch(drawn, mark, fresh)
            own = detected.batch(drawn[~filmed] - len(items))
            if not bool(filmed.any()):
                return own
            other = items.batch(drawn[filmed], mark[filmed], fresh)
            back = torch.cat([filmed.nonzero(), (~filmed).nonzero()]).flatten().argsort()
            return Batch(*(torch.cat(pair)[back] for pair in zip(other, own, strict=True)))

        return BatchLoader(make, steps)

    def val_dataloader(self) -> BatchLoader | list[BatchLoader]:
        """All windows of the validation files from all views, with their truth, in order; none without files."""
        return self._in_order("val")

    def test_dataloader(self) -> BatchLoader | list[BatchLoader]:
        """All windows of the test files from all views, with their truth, in order; none without files."""
        return self._in_order("test")

    def _in_order(self, split: str) -> BatchLoader | list[BatchLoader]:
        if not self._named(split):
            return []
        items = self._set(split)

        def make(epoch: int, step: int) -> Batch:
            own = torch.arange(step * self.batch_size, min((step + 1) * self.batch_size, len(items)))
            return items.batch(own, torch.ones_like(own, dtype=torch.bool))

        return BatchLoader(make, math.ceil(len(items) / self.batch_size), fixed=True)

    def _detected(self) -> DetectedWindows | None:
        """The windows of 2D tracks, where there are any."""
        if self.tracks and self.detected is None:
            self._check_apart()
            self.detected = DetectedWindows.cut(
                self._track_files(),
                reading=self.reading,
                skeleton=self.skeleton,
                fps=self.fps,
                window=self.window,
                stride=self.stride,
            )
        return self.detected

    def _named(self, split: str) -> Patterns:
        """The files of a split, or what stands for made-up motion; nothing where there is none."""
        own = self.files[split]
        return SYNTHETIC if not own and self.files["train"] == SYNTHETIC else own

    def _set(self, split: str) -> FilmedWindows:
        if split not in self.sets:
            train = split == "train"
            self.sets[split] = FilmedWindows.cut(
                self._clips(split),
                window=self.window,
                stride=self.stride if train else self.window,
                to_the_end=not train,
                views=self.views,
                pitch=self.pitch,
                noise=self.noise,
                occlusion=self.occlusion,
                key=(self.seed, split),
            )
        return self.sets[split]

    def _clips(self, split: str) -> list[Clip]:
        if self._named(split) == SYNTHETIC:
            count = self.num_clips if split == "train" else max(2, self.num_clips // 4)
            return synthetic_clips(
                count,
                skeleton=self._body(split) or "h36m17",
                fps=self.fps or 30.0,
                units=self.units,
                seed=self.seed,
                split=split,
            )
        self._check_apart()
        return file_clips(
            self._files(split),
            skeleton=self._body(split),
            fps=self.fps,
            up=self.up,
            units=self.units,
            file_units=self.file_units,
            file_fps=self.file_fps,
        )

    def _check_apart(self) -> None:
        """Make sure that no file is in two splits, by whatever paths, and that 2D tracks are of neither val nor test.

        Raises:
            OptionError: one is.
        """
        files = {split: {path.resolve(): path for path in self._files(split)} for split in self.files}
        files["tracks"] = {path.resolve(): path for path in self._track_files()}
        for one, other in itertools.combinations(files, 2):
            twice = files[one].keys() & files[other].keys()
            if twice and (one, other) != ("train", "tracks"):
                raise OptionError(
                    f"data: {files[one][min(twice)]} is in {one} and in {other}: leave it out of one by a pattern !..."
                )

    def _files(self, split: str) -> list[Path]:
        named = self._named(split)
        return find_files(named, self.folder) if named and named != SYNTHETIC else []

    def _track_files(self) -> list[Path]:
        return find_files(self.tracks, self.folder, of="2D tracks", folders=True) if self.tracks else []

    def _body(self, split: str) -> str | Path | Skeleton | None:
        """The skeleton that was asked for, or that of the training files."""
        return self.body if self.body is not None or split == "train" else self._set("train").skeleton

    def _items(self, *, labelled: bool) -> Tensor:
        """Training items of one kind, in random order."""
        train = self._set("train")
        order = torch.randperm(len(train), generator=generator_of(self.seed, "labels"))
        shown = train.revealed(self.labelled, generator_of(self.seed, "revealed"))
        return order[shown[order // self.views] == labelled]

"""PKC: Procrustean kinematic chains, this library's own method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from kcs_torch.clean.detector import detected, found_by_detector
from kcs_torch.clean.sides import unswap
from kcs_torch.errors import OptionError
from kcs_torch.functional.camera import complete_rotation
from kcs_torch.methods.answer.root import standing_feet
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.clips.lockstep import Search, run, together
from kcs_torch.methods.pkc.around import turned_around
from kcs_torch.methods.pkc.batch import Sized, is_descent, serve
from kcs_torch.methods.pkc.blocks import Turned, search
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.cleaning import cleaned
from kcs_torch.methods.pkc.clip import LEAST_JOINTS, Clip
from kcs_torch.methods.pkc.elsewhere import without_others, without_strange_limbs
from kcs_torch.methods.pkc.ends import estimate_with_ends, with_ends, without_ends
from kcs_torch.methods.pkc.fixed_answer import from_hypotheses
from kcs_torch.methods.pkc.gaps import EXACT, gaps_of, likelier, usual_noise
from kcs_torch.methods.pkc.gate import without_border, without_doubled, without_repeats
from kcs_torch.methods.pkc.hands import Part, joined, part_of, parts_of
from kcs_torch.methods.pkc.held import with_lengths_held
from kcs_torch.methods.pkc.hypotheses import Hypotheses, refined
from kcs_torch.methods.pkc.limbs import outward
from kcs_torch.methods.pkc.long_gaps import first_frame, lengthened, shortened
from kcs_torch.methods.pkc.moving_answer import MOVING_STEPS, STILL, from_moving
from kcs_torch.methods.pkc.moving_search import MovingSearch, is_small, too_long
from kcs_torch.methods.pkc.moving_solutions import MovingView
from kcs_torch.methods.pkc.moving_view import relative_weights, settled
from kcs_torch.methods.pkc.near import SEEMS_FAR, SEEMS_NEAR, Asked
from kcs_torch.methods.pkc.sizing import TRIED, resized, with_size
from kcs_torch.methods.pkc.stuck import without_stuck
from kcs_torch.methods.sfam import SfAM
from kcs_torch.nn.posture import has_trunk
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Reconstruction, Tracks

__all__ = ["PKC"]

ROUNDING = 8.0
"""Size of the body, over where it is and the machine precision, up to which it is a point."""

AGAIN = 3
"""How often depths of the moving viewpoint are refined anew until they settle."""

FILLS = 3
"""How often gaps are filled in space: the first time the search is made once more, if the viewpoint turns; then, where
it sways, what was found is polished further."""

FAR = 90.0
"""Degrees of the trunk's turn from which on the viewpoint's turn tells more than a template in clips of few frames."""

TWO_FRAMES = "depth is little more than a guess: two frames fit bodies of any depth, and three that differ are needed"


@dataclass(frozen=True)
class PKC(Method):
    """Both papers' ideas in one statistical model in bone space; the default of :func:`kcs_torch.reconstruct`.

    Bone vectors, aligned frame by frame to a common pose, follow one Gaussian, and so do their changes in time; bones
    keep their length. Where the viewpoint turns this alone gives depth (:func:`moving_view`), of markers, animals and
    robots, say. With a template the viewpoint may stand still: the depth of a bone is +-sqrt(L^2 - |xy|^2), and lengths
    and signs come from the skeleton's template, spreads and hinges (:func:`fixed_view`); one objective ranks many
    hypotheses, mirror images among them. docs/pkc.md derives it all.

    Args:
        viewpoint: "fixed" lifts by the template, "moving" by the viewpoint's turn; "auto" by the template if there is
            one, and by both where the trunk turns. Known cameras tell the sign of depth, and rank solutions.
        denoise: first leave out joints that only repeat another, or lie on the image's border, where some detectors put
            those outside; frames that repeat the one before, or in which the whole body leaps away, to somebody else,
            and back; and joints that do, or are stuck where they were. Swap left and right back where a detector
            mistakes them (:func:`kcs_torch.clean.unswap`); smooth noisy tracks, fill gaps and reject outliers
            (:func:`kcs_torch.solvers.denoise_tracks`).
        lifts: random starts of the moving viewpoint's solver, for skeletons without a template.
        rounds: of discrete moves of the fixed viewpoint's solver; with 0 gaps stay as each joint's own path fills them,
            too. Nothing without a template.
        steps: L-BFGS steps of each of its refinements; nothing without a template.
        alternatives: further solutions to return at most. Without a template these are the mirror image and bodies that
            fit the tracks nearly as well, of which there are often none.
        contacts: rank solutions by feet that stand still in the image, and so in space, too, unless the camera goes
            round the body; to be switched off for one that follows it.
        detections: whether joints are a detector's, whose errors last, rather than exact or with white noise. None: as
            confidences of many values tell, noise that lasts, and noise of a skeleton that detectors have.
        seed: of the random starts.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "pkc"
    differentiates: ClassVar[bool] = False
    turns_over: ClassVar[bool] = True
    reckons_in_seconds: ClassVar[bool] = True
    centred: ClassVar[bool] = False  # noise and outliers are told apart before the middle is taken
    viewpoint: Literal["auto", "fixed", "moving"] = "auto"
    denoise: bool = True
    lifts: int = 6
    rounds: int = 1
    steps: int = 30
    alternatives: int = 4
    contacts: bool = True
    detections: bool | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for field, least in (("lifts", 1), ("rounds", 0), ("steps", 1), ("alternatives", 0)):
            self._expect(getattr(self, field) >= least, field, f"at least {least}")

    def knows_template(self, skeleton: Skeleton) -> bool:
        return has_trunk(skeleton)

    def prepared(self, tracks: Tracks) -> Tracks:
        if self.denoise:
            tracks = without_stuck(without_repeats(without_border(without_doubled(tracks))))
            tracks = without_others(tracks)
            tracks = without_strange_limbs(unswap(without_strange_limbs(tracks, swapped=True)))
        told = self.detections
        if told is None and self.denoise and not detected(tracks) and found_by_detector(tracks):
            told = True
        return tracks if told in (None, tracks.detector) else replace(tracks, detector=told)

    def without_ends(self, tracks: Tracks) -> Tracks:
        return without_ends(tracks)

    def with_ends(self, result: Reconstruction, tracks: Tracks) -> Reconstruction:
        return result if result.skeleton == tracks.skeleton else with_ends(result, tracks)

    def following(self, searched: bool = True) -> PKC:
        """The same without contacts: what stands still in space does not in the image."""
        if not searched:
            return replace(self, contacts=False)
        return _Followed(**{f.name: getattr(self, f.name) for f in fields(self)} | {"contacts": False})

    def _seems_near(self, tracks: Tracks, flat: Tensor, depth: Tensor, unit: float, cameras: Tensor | None) -> str:
        """How near the camera seems: nothing is said here, but see :mod:`~kcs_torch.methods.perspective`."""
        return ""

    @property
    def _moves(self) -> int:
        """Rounds of discrete moves; under perspective they are made afterwards, along the rays."""
        return 0 if isinstance(self, _Followed) else self.rounds

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Clean the tracks, try both viewpoints, rank what they give."""
        return run(self._steps(tracks, cameras), serve)

    def solve_all(self, tracks: Sequence[Tracks]) -> list[Estimate]:
        """Several clips, whose hypotheses are refined together."""
        return run(together([self._steps(one, None) for one in tracks], late=is_descent), serve)

    def _steps(self, tracks: Tracks, cameras: Tensor | None) -> Search[Any, Any, Estimate]:
        shown = without_ends(tracks)
        if shown is not tracks:
            found = yield from self._steps(shown, cameras)
            return estimate_with_ends(found, shown, tracks)
        parts = parts_of(tracks)
        if parts:
            return (yield from self._by_parts(tracks, cameras, parts))
        if tracks.num_frames == 1 and self.knows_template(tracks.skeleton):
            return (yield from self._image(tracks, cameras))
        kept = shortened(tracks)
        if kept is None:
            return (yield from self._whole(tracks, cameras))
        some = replace(tracks, points=tracks.points[kept], weights=tracks.weights[kept])
        seen_by = None if cameras is None else cameras[kept]
        if len(kept) == 1 and self.knows_template(tracks.skeleton):
            found = yield from self._image(some, seen_by)
        else:
            found = yield from self._whole(some, seen_by, kept)
        return lengthened(found, kept, tracks, cameras)

    def _by_parts(self, tracks: Tracks, cameras: Tensor | None, parts: Sequence[Part]) -> Search[Any, Any, Estimate]:
        """Solve the body, and each hand by itself."""
        shown = [self._normalised(part_of(tracks, part)) for part in parts]
        methods = [self, *(self._for_hands() for _ in parts[1:])]
        steps = [one._steps(some, cameras) for one, (some, _) in zip(methods, shown, strict=True)]
        found = joined(parts, (yield from together(steps)), [size for _, size in shown], tracks.num_joints)
        return replace(found, alternatives=found.alternatives[: self.alternatives])

    def _for_hands(self) -> PKC:
        """What solves hands: the same."""
        return self

    def _image(self, tracks: Tracks, cameras: Tensor | None) -> Search[Any, Any, Estimate]:
        """Solve a single image as two of the same: as one its bones would rather be of usual lengths than as seen."""
        points, weights = (x.expand(2, *x.shape[1:]) for x in (tracks.points, tracks.weights))
        both = replace(tracks, points=points, weights=weights)
        found = yield from self._whole(both, None if cameras is None else cameras.expand(2, 2, 3))
        return first_frame(found)

    def _whole(self, tracks: Tracks, cameras: Tensor | None, time: Tensor | None = None) -> Search[Any, Any, Estimate]:
        """Solve tracks without long gaps, of which each frame has its time (T,)."""
        tracks = replace(tracks, skeleton=outward(tracks.skeleton))
        points, noise, notes = yield from cleaned(tracks, self.denoise, self.knows_template(tracks.skeleton), time)
        standing = standing_feet(replace(tracks, points=points))
        image = points - points.mean(-2, keepdim=True)
        rounding = ROUNDING * torch.finfo(points.dtype).eps * float(points.abs().amax())
        if float(image.abs().amax()) <= rounding:  # all joints lie at one point
            image = torch.zeros_like(image)
        (size,) = yield [Sized(replace(tracks, points=image))]
        found = yield from self._solve(Clip(tracks, points, image, noise, standing, cameras, size, notes))
        every = [replace(one, standing=standing) for one in (found, *found.alternatives)]
        return replace(every[0], alternatives=tuple(every[1:]))

    def _solve(self, clip: Clip) -> Search[Any, Any, Estimate]:
        """Solve a clip in which the body's size may change."""
        skeleton, size = clip.tracks.skeleton, clip.size
        if self.knows_template(skeleton):
            return (yield from self._with_template(clip))
        if self.viewpoint == "fixed":
            raise OptionError(
                f"pkc: viewpoint: 'fixed' needs a skeleton with a template and a trunk; '{skeleton.name}' has none"
            )
        made = yield from self._without_template(clip.even() if size.sure else clip)
        return with_size(made, size) if size.sure else made

    def _with_template(self, clip: Clip) -> Search[Any, Any, Estimate]:
        """Solve a body with a template: by a search with and without a change of size, and by the viewpoint's turn."""
        size, even, skeleton, rate = clip.size, clip.even(), clip.tracks.skeleton, clip.tracks.rate
        # What is not sure by itself is compared with solutions without a change.
        changing = size.surely if clip.many and self.viewpoint != "moving" else size.sure
        shown, method = even if changing else clip, self
        feet = clip.standing if self.contacts and clip.telling is None and self.viewpoint != "moving" else None
        body = Body(skeleton, shown.image, rate, clip.noise, feet)
        polished = clip.enough and body.spanned and not clip.detections
        compared = polished and self.viewpoint == "auto"
        turned = self._turned(shown, body.factor)
        if clip.enough and self.viewpoint == "moving":
            moving, _ = yield from self._moving(shown)
            found = yield from self._ranked(body, moving)
        else:
            resizing = clip.many and not changing and size.range >= TRIED and (clip.detections or size.likely)
            compare = turned if compared and clip.many and not resizing else None  # both must be searched alike
            near = Asked(self._seems_near, clip.tracks, clip.points, clip.cameras, body)
            found = yield from search(body, self._moves, self.steps, compare, near)
            if near.told == SEEMS_NEAR:  # the rest is as under perspective
                method = self.following()
            if near.told and (near.told != SEEMS_FAR or not body.turns(found)):  # else signs were poor: ask again later
                clip = replace(clip, notes=(*clip.notes, near.told))
            led = compared and body.is_odd(found) and body.turns(found)  # by the viewpoint's turn, not by the template
            if resizing and (size.sure or not led):
                other = Body(skeleton, even.image, rate, clip.noise, feet, body.pace)
                better = yield from resized(found, body, other, size, method._moves, self.steps)
                if better is not None:
                    changing, body, found = True, other, better
                    turned = self._turned(even, body.factor)
            if clip.cameras is None and body.seen_from_around(found):
                found = body.without_contacts(found)
        made = yield from method._answered(clip, body, found, polished, turned if compared else None)
        return with_size(made, size) if changing else made

    def _answered(
        self, clip: Clip, body: Body, found: Hypotheses, polished: bool, turned: Turned | None
    ) -> Search[Any, Any, Estimate]:
        """Hypotheses told apart by known cameras, polished if they may be, with gaps filled anew; as an estimate.

        Where the viewpoint turns, what it tells by itself, ``turned``, is a rival.
        """
        if clip.telling is not None:
            found = yield from body.seen_from(found, clip.telling, self.steps)
        around = polished and body.turns(found, 0.0 if clip.many else FAR)
        if around or (polished and clip.many and not isinstance(self, _Followed)):
            rival = (yield from turned(body.is_odd(found))) if turned is not None and around else None
            if self._fills(body):
                found, body = yield from self._filled(clip, body, found, rival)
            else:
                found = yield from self._polished(clip, body, found, rival)
        return from_hypotheses(
            found, body, clip.cameras, clip.notes, telling=clip.telling, alternatives=self.alternatives,
            detections=clip.detections, told=self.steps >= 10,
        )  # fmt: skip

    def _without_template(self, clip: Clip) -> Search[Any, Any, Estimate]:
        """Solve a body of which nothing is known by the viewpoint's turn, if there is enough of it, or by SfAM."""
        tracks, cameras = clip.tracks, clip.cameras
        if clip.enough:
            moving, first = yield from self._in_space(clip)
            return from_moving(moving, first, tracks.skeleton, cameras, clip.notes, alternatives=self.alternatives)
        seen = clip.complete()
        (first,) = (yield [seen]) if cameras is None else [SfAM().solve(seen, cameras)]
        made = replace(first, notes=(*clip.notes, "so few frames or joints are solved by sfam", *first.notes))
        if cameras is None and tracks.num_frames == 2:
            made = replace(made, doubt=TWO_FRAMES)
        if tracks.num_joints < LEAST_JOINTS:
            made = replace(made, points=with_lengths_held(clip.image, first.points, tracks.skeleton))
        return made

    def _fills(self, body: Body) -> bool:
        """Whether gaps are filled by what is found: of a first solution only the image is used if another follows."""
        return self.rounds > 0 and self.viewpoint != "moving" and bool(gaps_of(body.noise).any())

    def _filled(
        self, clip: Clip, body: Body, found: Hypotheses, rival: Tensor | None
    ) -> Search[Any, Any, tuple[Hypotheses, Body]]:
        """Hypotheses anew where joints are unseen here and there, and the body with its gaps filled in space.

        The first time they are only polished: what the viewpoint's turn tells of signs is left to the second. Where it
        hardly turns there is no second time: gaps filled so hold what was found.
        """
        found = yield from body.polished(found, self.steps, rival, clip.telling)
        for again in range(FILLS):
            if found.image is None or (again and not body.sways(found)):
                break
            before, stays, body = body.factor, body.stays(found), body.filled(found.image)
            ratio = body.factor / before
            if again or stays:
                found, rival = replace(found, depth=found.depth * ratio, lengths=found.lengths * ratio), None
            else:
                rival = None if rival is None else rival * ratio
                found = yield from search(body, self._moves, self.steps)
                if clip.telling is not None:
                    found = yield from body.seen_from(found, clip.telling, self.steps)
            if stays:
                break
            found = yield from self._polished(clip, body, found, rival)
        return found, body

    def _polished(
        self, clip: Clip, body: Body, found: Hypotheses, rival: Tensor | None
    ) -> Search[Any, Any, Hypotheses]:
        """Hypotheses, the best polished, and with other signs where the viewpoint's turn, depths (T, N), doubts it.

        Cameras that are known tell signs by themselves, also against the template.
        """
        found = yield from body.polished(found, self.steps, rival, clip.telling)
        if rival is None or not self._moves or clip.telling is not None or not body.turns(found):
            return found
        return (yield from turned_around(body, found, rival))

    def _moving(self, clip: Clip, count: int = 1, least: float = 0.0) -> Search[Any, Any, tuple[MovingView, Estimate]]:
        """So many solutions of the moving viewpoint at most, of ``least`` noise; and the first guess, SfAM's."""
        (first,) = yield [clip.complete()]
        start, usual = (first.points, complete_rotation(first.cameras)), max(usual_noise(clip.noise), least)
        weights = relative_weights(clip.noise, usual) if usual > 0 else None
        search = MovingSearch(
            clip.image, clip.tracks.skeleton, *start, weights=weights, noise=usual, lifts=self.lifts,
            alternatives=count, exact=usual == 0, seed=self.seed,
        )  # fmt: skip
        moving = yield from search.solve()
        return moving, first

    def _in_space(self, clip: Clip) -> Search[Any, Any, tuple[MovingView, Estimate]]:
        """As :meth:`_moving`; of exact tracks with gaps, whose x and y are unknowns there, with next to no noise.

        Of few joints bones that keep their length exactly tell more, and x and y in gaps more again: both are tried.
        """
        count, noise = max(1, self.alternatives), clip.noise
        loose = self.rounds and usual_noise(noise) == 0 and bool(gaps_of(noise).any()) and not too_long(clip.image)
        moving, first = yield from self._moving(clip, count, EXACT if loose else 0.0)
        if loose and is_small(clip.image):
            held, _ = yield from self._moving(clip, count)
            moving = yield from likelier(moving, held, clip.image, noise)
        frame = noise[:, clip.tracks.seen.any(0)].square().mean(1, keepdim=True)  # whose pose they turn
        return replace(moving, noise=(noise.square() + frame).sqrt()), first

    def _turned(self, clip: Clip, factor: Tensor) -> Turned:
        """What the viewpoint's turn tells, from many starts or from SfAM's guess: each worked out when first wanted."""
        known: dict[bool, Tensor] = {}

        def turned(far: bool) -> Search[Any, Any, Tensor]:
            if far and True not in known:
                moving, _ = yield from self._moving(clip)
                known[True] = moving.pose.points[0, ..., 2] * factor
            elif far not in known:
                (first,) = yield [clip.complete()]
                start = first.points, complete_rotation(first.cameras)
                known[False] = (yield from settled(clip.image, clip.tracks.skeleton, *start)) * factor
            return known[far]

        return turned

    def _ranked(self, body: Body, moving: MovingView) -> Search[Any, Any, Hypotheses]:
        """The moving viewpoint's solution and its mirror image, of a body with a template."""
        depth = moving.pose.points[:1, ..., 2] * body.factor
        ranked = yield from body.rank(torch.cat([depth, -depth]), self.steps)
        for _ in range(AGAIN):  # depths found under another objective may have far to go
            if ranked.moved is None or bool(ranked.moved[0] <= STILL):
                break
            ranked = yield from refined(body.objective, ranked, self.steps)
        return replace(ranked, steps=ranked.steps + MOVING_STEPS)


class _Followed(PKC):
    """Whose solutions are refined, searched and polished under perspective."""

"""The objective's value and gradient in one pass, written out: PKC spends most of its time here."""

from __future__ import annotations

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, incidence
from kcs_torch.methods.pkc.image import Image, Slopes, bend_cost, turned
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.sides import Sides
from kcs_torch.methods.pkc.trunk_frame import TrunkFrame
from kcs_torch.methods.pkc.unknowns import Unknowns
from kcs_torch.methods.pkc.weights import ANCHOR, CORNER, HEAVY, NOISE, wide
from kcs_torch.nn.lengths import HIDDEN

__all__ = ["ObjectiveGradient"]


class ObjectiveGradient:
    """Energy (H,) and gradient (H, B T + B) over the unknowns, equal to autograd's of :meth:`Objective.terms`.

    All terms are functions of the bones' depths dz and of the logarithms of their lengths: joints are never formed,
    and what the image alone decides is made once. Time comes last, so that what belongs to a bone or to a frame is
    spread over long rows.

    Args:
        objective: what is minimised.
        unknowns: its coordinates; only :meth:`at` goes without.
    """

    def __init__(self, objective: Objective, unknowns: Unknowns | None = None) -> None:
        self.objective, self.unknowns, self.weights = objective, unknowns, objective.weights
        obj, body, like = objective, objective.skeleton, objective.image
        self.noise = _early(obj.noise).square() if obj.noisy else None
        self.rigid = obj.rigid[None, :, None] if obj.rigid.ndim == 1 else _early(obj.rigid)
        self.time = None if obj.time is None else obj.time[:, None]  # (H, 1, T)
        ends = incidence(obj.bones, body.num_joints, dtype=like.dtype).mT
        mix = ends @ obj.complete.mT @ obj.tree[: body.num_observed]  # virtual joints move bones with others
        eye = torch.eye(len(mix), dtype=like.dtype, device=like.device)
        self.mix = None if bool((mix - eye).abs().amax() < 1e-9) else mix
        self.lines = torch.cat([self._take_posture(like), *self._take_hinges(like)])  # (2 + 3 hinges, B)
        own = bone_vectors(obj.image, obj.bones).movedim((-1, -2), (-3, -2))  # (..., 2, B, T)
        self.image = self.imaged(own if own.ndim == 4 else own[None])
        self._take_lengths(like)

    def _take_posture(self, like: Tensor) -> Tensor:
        """Hold what posture and stance need; returns the lines (2, B) that make the trunk's long axes of bones."""
        obj, posture, stance = self.objective, self.objective.posture, self.objective.stance
        self.axes = posture.axes.to(like)
        self.sides = sides = Sides(posture)
        spread = posture.deviation.to(like).mT[..., sides.order].reshape(-1, 3, len(obj.bones))
        self.spread = spread * sides.share.to(like)  # (1 or H, 3, B)
        self.mean = (posture.mean.to(like).mT[:, sides.order] / self.spread).flatten(1)[..., None]  # (1 or H, 3B, 1)
        self.feet = stance.line.to(like)[sides.order]  # 0 where nothing stands on the ground
        self.beneath = stance.usual.to(like)[:, None]  # (2, 1)
        affine = posture.affine.to(like)
        return (affine - affine.mean(-1, keepdim=True)) @ obj.tree[posture.trunk]

    def _take_hinges(self, like: Tensor) -> list[Tensor]:
        """Hold what hinges and adduction need; returns the lines (hinges, B) of bones above and below, and of axes.

        Upper arms and thighs, which must not reach far across the body, are bones above hinges: these come first.
        """
        obj, w, hinges, limbs = self.objective, self.weights, self.objective.hinges, self.objective.adduction
        share = 1.0 if self.time is None else self.time
        above = hinges.joints[:, [0, 1, 3, 4]].tolist()
        first = [above.index(limb) for limb in limbs.joints.tolist()]
        order = first + [k for k in range(len(above)) if k not in first]
        self.outer = len(first)
        self.hinged, self.sign, self.side = hinges.limbs[order], hinges.sign.to(like)[order], -limbs.side.to(like)
        self.firm = wide(w.hinge / w.sine**2, 2) * hinges.firm.to(like)[order, None] * share  # (1 or H, hinges, 1 or T)
        self.reach = wide(w.adduction / w.sine**2, 2) * share
        ends = torch.nn.functional.one_hot(self.hinged, len(obj.bones)).to(like)  # (hinges, 2, B)
        self.bent, self.reached = -ends.sum(1), -ends[: self.outer, 0]  # whose lengths a hinge's cost depends on
        parent, joint, child, left, right = hinges.joints[order].unbind(1)
        return [obj.tree[a] - obj.tree[b] for a, b in ((joint, parent), (child, joint), (left, right))]

    def _take_lengths(self, like: Tensor) -> None:
        """Hold what foreshortening and proportions need."""
        obj, free, sizes = self.objective, self.objective.foreshortening, self.objective.proportions
        self.limbs = free.free.nonzero().flatten()
        clear = _early(obj.clear).index_select(1, self.limbs)
        self.clear = clear * (free.free.to(like)[self.limbs, None] / free.correlation)
        self.held = self.clear.sum(-1)
        least = torch.finfo(like.dtype).tiny ** 0.25  # squares of it are not 0
        self.blur = HIDDEN * _early(obj.noise).index_select(1, self.limbs).clamp_min(least)
        self.usual = sizes.usual.to(like).clamp_min(torch.finfo(like.dtype).tiny).log()
        twins = torch.nn.functional.one_hot(sizes.pairs, len(obj.bones)).to(like)
        self.twins = (twins[:, 0] - twins[:, 1]) / sizes.twins  # (pairs, B)

    def imaged(self, bones: Tensor, rays: Tensor | None = None) -> Image:
        """What an image of the bones, (K, 2, B, T), decides, and the rays of their outer ends."""
        return Image.of(bones, self.lines, self.sides.order, self.outer, rays)

    def __call__(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Value (H,) and gradient (H, B T + B) of unknowns (H, B T + B)."""
        u = self.unknowns
        assert u is not None
        count, bones, frames = u.dz.shape
        part, grown = (state * u.scale).split([bones * frames, bones], 1)
        own = torch.addcmul(part.view(count, bones, frames), u.shear, grown[..., None]).add_(u.dz)
        value, slope, growth = self.at(own, u.lengths * grown.exp())
        growth += (slope * u.shear).sum(-1)
        return value, torch.cat([slope.flatten(1), growth], 1).mul_(u.scale)

    def rows(self, index: Tensor) -> ObjectiveGradient:
        """That of some hypotheses."""
        assert self.unknowns is not None
        unknowns = self.unknowns.rows(index)
        return ObjectiveGradient(unknowns.objective, unknowns)

    def at(self, own: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Value (H,) of bones' depths (H, B, T) and lengths (H, B), its derivatives in depths and log lengths."""
        value, out = self._at(own, lengths, self.image, None)
        return value, out.depth, out.growth

    def with_image(
        self, own: Tensor, lengths: Tensor, bones: Tensor, rays: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """As :meth:`at`, for another image of the bones, (H, 2, B, T), and the derivatives in it and in log rays.

        Its noise and gaps are taken to be those of the objective's own. How likely foreshortened bones are is a matter
        of their depths along rays (u, v, 1) of their outer ends: (H or 1, 2, B, T), 0 where they are parallel.
        """
        drawn = torch.empty_like(bones)
        value, out = self._at(own, lengths, self.imaged(bones, rays), drawn)
        return value, out.depth, out.growth, drawn, out.rays

    def _at(self, own: Tensor, lengths: Tensor, image: Image, drawn: Tensor | None) -> tuple[Tensor, Slopes]:
        count = len(own)
        dz = own if self.mix is None else self.mix @ own
        value, slope, growth = self._lengths(dz, lengths, image, drawn)
        lines = self.lines @ dz
        out = Slopes.of(slope, growth, lines, drawn)
        value = value + bend_cost(dz, 1 / wide(self.weights.acceleration, 2) ** 2, slope, self.time)
        value = value + self._posture(dz, lengths, image, lines[:, :2], out)
        if len(self.lines) > 2:
            value = value + self._hinges(lengths, image, lines[:, 2:], out)
        value = value + self._foreshortening(dz, lengths, image, out)
        value = value + self._sizes(lengths, growth)
        slope.baddbmm_(self.lines.mT.expand(count, -1, -1), out.lines)
        if drawn is not None:
            drawn += self.lines.mT @ out.flat_lines
        return value, out if self.mix is None else out._replace(depth=self.mix.mT @ slope)

    # Each term returns its value (H,) and adds its derivatives to the slopes.

    def _lengths(
        self, dz: Tensor, lengths: Tensor, image: Image, drawn: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        obj, size = self.objective, lengths[..., None]
        least = wide(self.weights.length, 2) ** 2
        off = torch.addcmul(image.flat, dz, dz).div_(2 * size).sub_(size / 2)
        if self.noise is None:
            precision = self.rigid / least
        else:
            ratio = self.image.flat / size.square()
            variance = ratio.clamp_max(1).mul_(self.noise)
            total = variance + least
            precision = self.rigid / total
        each = off.square().mul_(precision / HEAVY)
        count = wide(obj.count, 1)
        spread = each.log1p().sum(-1) * (HEAVY / count)
        if self.noise is None:
            value, pull = spread, torch.ones_like(spread)
        else:
            noise = NOISE / count * (self.rigid - least * precision).sum(-1)
            over = spread - noise
            root = (over.square() + (CORNER * noise).square() + 1e-12).sqrt()
            value, pull = (over + root) / 2, (1 + over / root) / 2
            push = -pull + CORNER**2 * noise / root / 2
        outer = 0.5 / (1 + value)  # times count: d value / d spread
        pull = pull * outer
        inverse = each.add_(1).reciprocal_()  # 1 / (1 + p off^2 / 4)
        bent = precision * off * inverse  # p off / (1 + p off^2 / 4)
        growth = -2 * pull * (HEAVY * (dz.shape[-1] - inverse.sum(-1)) + lengths * bent.sum(-1))
        if self.noise is not None:
            steep = 2 * variance / total * (ratio <= 1)  # d log p / d log L
            drift = pull[..., None] * HEAVY * (1 - inverse) - (push * outer)[..., None] * (NOISE * least) * precision
            growth = growth + (steep * drift).sum(-1)
        bent.mul_((2 * pull / lengths)[..., None])
        if drawn is not None:
            torch.mul(bent[:, None], image.bones, out=drawn)
        slope = bent.mul_(dz)
        return obj.count / 2 * value.log1p().sum(-1), slope, growth

    def _posture(self, dz: Tensor, lengths: Tensor, image: Image, depths: Tensor, out: Slopes) -> Tensor:
        obj, posture = self.objective, self.objective.posture
        count, bones, frames = dz.shape
        trunk = TrunkFrame(*torch.cat([image.plane.expand(count, -1, -1, -1), depths[:, :, None]], 2).unbind(1))
        turn = self.axes @ trunk.directions().flatten(2)
        turn = turn.view(count, 3, 3, 1, frames)  # [k, j]: how much of coordinate j is in direction k
        # How bones stray from their usual directions, seen from the trunk, less that share of their mean for which the
        # prior does not charge: log det(I + Z Z^T) is then all there is to it.
        sides = self.sides
        scale = (
            (lengths.index_select(1, sides.order)[:, None] * self.spread).reciprocal_().flatten(1)[..., None]
        )  # (H, 3B, 1)
        own = dz.index_select(1, sides.order)
        if self.time is not None:
            own = own * self.time
        y = turn[:, :, 0] * image.seen[0][:, None]
        y.addcmul_(turn[:, :, 1], image.seen[1][:, None]).addcmul_(turn[:, :, 2], own[:, None])
        stance, strayed = self._stance(y)
        seen = y.view(count, 3 * bones, frames)
        real = wide(obj.count, 2)
        amount = real / wide(self.weights.posture, 2)  # what these frames count
        root, part = (amount / (real * posture.strength)) ** 0.5, (posture.kappa / (amount + posture.kappa)) ** 0.5
        mean = scale * seen.sum(-1, keepdim=True) / real - self.mean
        seen.mul_(root * scale)
        self._lower(seen, root * (self.mean + (1 - part) * mean))
        halves = sides.apart(seen)  # (S H, K, T)
        log_det, pull = _log_det(halves)
        firm = amount + posture.strength
        log_det = log_det.view(-1, count).sum(0)
        value = log_det * (firm[:, 0, 0] if isinstance(firm, Tensor) else firm)
        pull = sides.joined(pull, count)  # (H, 3B, T)
        moved = (pull * seen).sum(-1, keepdim=True)
        pull.mul_(firm * root * scale)
        total = pull.sum(-1, keepdim=True)
        grown = (firm * moved + part * total * self.mean / scale).view(count, 3, bones).sum(1)
        out.growth.sub_(grown.index_select(1, sides.back))
        self._lower(pull, (1 - part) * total / real)
        pull = pull.view_as(y)
        pull[:, ::2].addcmul_(strayed[:, :, None], self.feet[:, None])
        out.depth.add_((pull * turn[:, :, 2]).sum(1).index_select(1, sides.back))
        each = [(pull * v[:, None]).sum(2) for v in (*image.seen, own)]  # (H, 3, T): of k, for each j
        into = self.axes.mT @ torch.stack(each, 2).flatten(2)  # (H, 3, 3 T)
        a, b = trunk.slopes(into.view(count, 3, 3, frames))
        out.lines[:, 0], out.lines[:, 1] = a[:, 2], b[:, 2]
        if out.image is not None:
            for j in (0, 1):
                out.image[:, j] += (pull * turn[:, :, j]).sum(1).index_select(1, sides.back)
            out.flat_lines[:, :, 0], out.flat_lines[:, :, 1] = a[:, :2], b[:, :2]
        return value + stance

    def _stance(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Value (H,) of bones (H, 3, B, T) seen from the trunk, and slopes (H, 2, T) in where the feet are."""
        stance, weight = self.objective.stance, wide(self.weights.stance, 2)
        off = self.feet @ seen[:, ::2] - self.beneath
        if self.time is not None:
            off = off * self.time
        back = off[:, 1].clamp_min(0)
        square = back.square()
        far = (off.square().sum(1) - square).mul_(stance.fold**-2).add_(1)
        total = square.add_(far.log(), alpha=stance.fold**2).sum(-1, keepdim=True)
        total = total.div_(wide(self.objective.count, 1)).add_(stance.sway**2)[..., None]
        slope = off / far[:, None]
        torch.where(back > 0, back, slope[:, 1], out=slope[:, 1])
        value = weight / 2 * (total / stance.sway**2).log()
        return value[:, 0, 0], slope.mul_(weight / (total * wide(self.objective.count, 2)))

    def _lower(self, values: Tensor, by: Tensor) -> None:
        """Take (H, C, 1) from values (H, C, T), but in frames that pad a clip."""
        if self.time is None:
            values -= by
        else:
            values.addcmul_(by, self.time, value=-1)

    def _hinges(self, lengths: Tensor, image: Image, depths: Tensor, out: Slopes) -> Tensor:
        deep = depths.unflatten(1, (3, -1))  # (H, 3, hinges, T) of bones u above hinges, v below, and axes a
        axis, upper = deep[:, 2], deep[:, 0, : self.outer]
        square = axis.square() + image.across
        total = (square if self.time is None else square * self.time).sum(-1)
        total.masked_fill_(total == 0, torch.inf)  # an axis of no length has no hinge
        size = (total / wide(self.objective.count, 1)).sqrt()
        above, below = lengths[:, self.hinged].unbind(-1)  # (H, hinges)
        scale = (self.sign / (above * below * size))[..., None]
        wrong = (deep * image.turns).sum(1).mul_(scale).clamp_min_(0)
        pull = wrong * self.firm
        energy = (pull * wrong).sum(-1)  # twice that of each hinge
        pull.mul_(scale)
        back = out.lines[:, 2:].unflatten(1, (3, -1))
        torch.mul(pull[:, None], image.turns, out=back)
        flat = None if out.image is None else out.flat_lines[:, :, 2:].unflatten(2, (3, -1))
        if flat is not None:
            torch.mul(pull[:, None, None], turned(torch.cat([image.edges, deep[:, None]], 1))[:, :2], out=flat)
        out.growth.addmm_(energy, self.bent)
        value, shrink = energy.sum(-1) / 2, energy
        if self.outer:  # the same for bones that reach across: -(u . a) / (|u| |a|) is at most the limit
            some = slice(self.outer)
            scale = (self.side / (above * size)[:, some])[..., None]
            across = torch.addcmul(image.along, upper, axis[:, some]).mul_(scale)
            wrong = (across - self.objective.adduction.limit).clamp_min_(0)
            pull = wrong * self.reach
            each = (pull * across).sum(-1)
            value = value + (pull * wrong).sum((1, 2)) / 2
            pull.mul_(scale)
            back[:, 0, some].addcmul_(pull, axis[:, some])
            back[:, 2, some].addcmul_(pull, upper)
            if flat is not None:
                flat[:, :, 0, some].addcmul_(pull[:, None], image.edges[:, :, 2, some])
                flat[:, :, 2, some].addcmul_(pull[:, None], image.edges[:, :, 0, some])
            out.growth.addmm_(each, self.reached)
            shrink[:, some] += each
        held = (shrink / total)[..., None]
        if self.time is not None:
            held = held * self.time
        back[:, 2].addcmul_(held, axis, value=-1)
        if flat is not None:
            flat[:, :, 2].addcmul_(held[:, None], image.edges[:, :, 2], value=-1)
        return value

    def _foreshortening(self, dz: Tensor, lengths: Tensor, image: Image, out: Slopes) -> Tensor:
        depth, size = dz.index_select(1, self.limbs), lengths[:, self.limbs]
        rays = None if image.rays is None else image.rays[:, :, self.limbs]
        if rays is not None:
            ahead = (rays * image.bones[:, :, self.limbs]).sum(1)
            depth = depth + ahead
        least = (self.objective.foreshortening.eps * size).square()[..., None]
        square, grown = depth.square(), least
        if self.objective.noisy:
            blur = self.blur * size[..., None]
            far = torch.hypot(square, blur)
            depth, grown = depth * (square / far), least + blur * (blur / far) / 2
            square = far
        square = square + least
        each = self.clear / square
        value = self.held * size.log() + (self.clear * square.log()).sum(-1) / 2
        out.growth.index_add_(1, self.limbs, self.held + (grown * each).sum(-1))
        pull = each * depth
        out.depth.index_add_(1, self.limbs, pull)
        if rays is not None and out.image is not None:
            out.image.index_add_(2, self.limbs, pull[:, None] * rays)
            out.rays.add_((pull * ahead).sum((1, 2)))
        return value.sum(-1)

    def _sizes(self, lengths: Tensor, growth: Tensor) -> Tensor:
        obj = self.objective
        prior = obj.proportions
        log = lengths.clamp_min(torch.finfo(lengths.dtype).tiny).log() - self.usual
        off = log - log.mean(-1, keepdim=True)
        half = (off / prior.spread).square_().mul_(0.5).add_(1)
        over = off.clamp_min(0) / prior.excess
        pull = torch.addcdiv(over / prior.excess, off, half, value=prior.spread**-2)
        apart = log @ self.twins.mT
        growth.add_(pull).sub_(pull.mean(-1, keepdim=True)).addmm_(apart, self.twins)
        value = half.log().sum(-1) + torch.cat([over, apart], 1).square_().sum(-1) / 2
        if obj.anchor is not None:
            away = (lengths / obj.anchor).log() / ANCHOR
            growth += wide(obj.held, 1) * away / ANCHOR
            value = value + obj.held * away.square().sum(-1) / 2
        return value


def _log_det(z: Tensor) -> tuple[Tensor, Tensor]:
    """Of Z (M, K, T) log det(I + Z Z^T), (M,), and (I + Z Z^T)^-1 Z."""
    few = z.shape[2] < z.shape[1]  # Z^T Z is then the smaller matrix, and (I + Z Z^T)^-1 Z = Z (I + Z^T Z)^-1
    scatter = torch.bmm(z.mT, z) if few else torch.bmm(z, z.mT)
    scatter.diagonal(dim1=-2, dim2=-1).add_(1)
    factor, info = torch.linalg.cholesky_ex(scatter)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    if bool(info.any()):  # a step so far that rounding or overflow leaves no scatter: it costs infinitely much
        log_det = torch.where(info > 0, torch.inf, log_det)
        factor = torch.where((info > 0)[:, None, None], torch.ones_like(factor[0, 0]).diag(), factor)
    inverse = torch.cholesky_inverse(factor)
    return log_det, torch.bmm(z, inverse) if few else torch.bmm(inverse, z)


def _early(values: Tensor) -> Tensor:
    """(..., T, B) as (1 or H, B, T)."""
    early = values.mT.contiguous()
    return early if early.ndim == 3 else early[None]

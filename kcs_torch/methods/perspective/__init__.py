"""Full perspective: any method before a pinhole camera, of known focal length or of one that the tracks tell.

``calibrated`` and ``uncalibrated`` are the two calls, the latter with an ``image_lens`` where there is one, and the
question whether the camera is ``near_or_far``; people before one camera have ``one_lens``. Each round looks at the body
by a ``view``, and is made by ``refining`` a method's solutions, of which ``parallel_image`` tells the image without
noise. A ``scene`` refines bodies on the energy of ``pinhole``, in ``pinhole_coordinates``, that of a ``plain_body``
where there is no template, and turns runs of signs over ``along_rays``. The best of them go into the ``answer``.
"""

from kcs_torch.methods.perspective.calibrated import reconstruct_perspective
from kcs_torch.methods.perspective.uncalibrated import reconstruct_uncalibrated

__all__ = ["reconstruct_perspective", "reconstruct_uncalibrated"]

"""What planes ask of the map in a refinement step: E_pgi (Eq. 4) and E_str (Eqs. 8, 9)."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from tgslam.camera import Camera
from tgslam.config.plane_settings import StructureConfig
from tgslam.device import runtime
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframes import Keyframe
from tgslam.map.plane_labels import PlaneLabels
from tgslam.ops import instance_field
from tgslam.ops.instance_field import InstanceGradient, InstanceTarget
from tgslam.ops.plane_regularisers import PlaneRegularisers
from tgslam.ops.render_images import RenderImages
from tgslam.ops.splats import MapGradient
from tgslam.planes.identity.codes import code_table
from tgslam.planes.instances.plane_table import PlaneTable


class StructureTerms:
    """The terms with their scratch memory, and what they know of planes and keyframes."""

    def __init__(self, camera: Camera, config: StructureConfig, kept_targets: int) -> None:
        """kept_targets: keyframes whose prepared images are kept, the most recently used ones."""
        self.config = config
        self._kept_targets = kept_targets
        self._workspace = instance_field.Workspace(camera.height, camera.width)
        self._regularisers = PlaneRegularisers(config)
        self._targets: OrderedDict[int, tuple[int, InstanceTarget]] = OrderedDict()  # by keyframe, of that version
        self._visits: dict[int, tuple[int, int]] = {}  # by keyframe, since its labels have this version
        self._version = -1
        self.know(PlaneTable.empty(), 0)

    def know(self, table: PlaneTable, version: int) -> None:
        """The planes as they are now. version: of the table; nothing is done for one that is known."""
        if version != self._version:
            self._version = version
            self._planes = runtime.to_device(table.planes_w) if len(table) else None
            self.codes = runtime.to_device(code_table(table.ids, self.config))

    def due(self, keyframe: Keyframe) -> InstanceTarget | None:
        """The keyframe's target, if E_pgi takes part in this step: embeddings converge in few, so not in each.

        It does as soon as what the keyframe shows of planes has changed.
        """
        if keyframe.labels is None or self.config.lambda_pgi == 0.0:
            return None
        version = keyframe.label_version
        known, visit = self._visits.get(keyframe.index, (version, 0))
        visit = visit if known == version else 0
        self._visits[keyframe.index] = version, visit + 1
        is_due = visit % self.config.expert.embedding.pgi_interval == 0
        return self._target(keyframe, keyframe.labels) if is_due else None

    def pgi(self, rendered: RenderImages, target: InstanceTarget, g_opacity: np.ndarray) -> InstanceGradient:
        """E_pgi at a rendering; its derivative by opacity is added to g_opacity [H, W]."""
        return instance_field.pgi_loss(
            rendered.embedding, rendered.opacity, target, self.codes, self.config, g_opacity, self._workspace
        )

    def regularise(self, gaussians: GaussianMap, visible: np.ndarray, gradient: MapGradient) -> None:
        """Add the gradient of E_str."""
        if self.config.lambda_str > 0.0 and self._planes is not None:
            self._regularisers.add(gaussians, visible, self._planes, gradient)

    def move_embeddings(
        self,
        gaussians: GaussianMap,
        visible: np.ndarray,
        gradient: MapGradient,
        target: InstanceTarget,
    ) -> None:
        """Relax the embeddings; the curvature's second column must hold the weights of E_pgi."""
        instance_field.relax(
            gaussians.count, visible, gradient.embedding, gradient.curvature, gaussians.array("contribution"), target,
            self.config, gaussians.embedding,
        )  # fmt: skip

    @property
    def parts(self) -> dict[str, float]:
        """Means of E_str's terms in the last step that had it: flat, normal, distance; count of Gaussians."""
        return self._regularisers.parts

    def _target(self, keyframe: Keyframe, labels: PlaneLabels) -> InstanceTarget:
        known = self._targets.pop(keyframe.index, None)
        if known is None or known[0] != keyframe.label_version:
            depth_m = runtime.to_device(keyframe.depth_m())
            known = (
                keyframe.label_version,
                instance_field.prepare(labels.image(), depth_m, self.config.expert.embedding),
            )
        self._targets[keyframe.index] = known
        while len(self._targets) > self._kept_targets:
            self._targets.popitem(last=False)
        return known[1]

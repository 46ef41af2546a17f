"""The public names of the package, for editors and type checkers."""
# ruff: noqa: I001

from zsp_lite import (
    alignment as alignment,
    backbones as backbones,
    baselines as baselines,
    benchmark as benchmark,
    best_view as best_view,
    choices as choices,
    cli as cli,
    course as course,
    data as data,
    errors as errors,
    estimates as estimates,
    features as features,
    importers as importers,
    io as io,
    matchers as matchers,
    matching as matching,
    metrics as metrics,
    minimal as minimal,
    objects as objects,
    pipeline as pipeline,
    points as points,
    scans as scans,
    verified as verified,
    views as views,
    viz as viz,
)
from zsp_lite.alignment import Sim3 as Sim3
from zsp_lite.backbones import checkpoints as checkpoints, huggingface as huggingface, vit as vit
from zsp_lite.backbones.backbone import Backbone as Backbone
from zsp_lite.backbones.load import load_backbone as load_backbone
from zsp_lite.data import (
    annotations as annotations,
    cameras as cameras,
    check as check,
    co3d as co3d,
    depth as depth,
    frames as frames,
    labels as labels,
    pairs as pairs,
)
from zsp_lite.data.cameras import Camera as Camera
from zsp_lite.data.co3d import Co3D as Co3D
from zsp_lite.data.frames import Frame as Frame
from zsp_lite.errors import InputError as InputError
from zsp_lite.estimates import PoseEstimate as PoseEstimate
from zsp_lite.features import FeatureMap as FeatureMap
from zsp_lite.importers.sources import open_source as open_source
from zsp_lite.io import download as download, files as files, ply as ply
from zsp_lite.matching import Matches as Matches
from zsp_lite.objects.align import align_category as align_category
from zsp_lite.objects.estimate import estimate_pose as estimate_pose
from zsp_lite.pipeline import ZeroShotPose as ZeroShotPose
from zsp_lite.viz import plots as plots, report as report

__version__: str

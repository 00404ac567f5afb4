"""From a history to a posterior over Φ and over which constraints exist."""

from boomdp_jax.inference.end_stops import without_stops as without_stops
from boomdp_jax.inference.fitted_kernel import structure_kernel as structure_kernel
from boomdp_jax.inference.identifiability import Identifiability as Identifiability
from boomdp_jax.inference.identifiability import identifiability as identifiability
from boomdp_jax.inference.infer import METHODS as METHODS
from boomdp_jax.inference.infer import infer as infer
from boomdp_jax.inference.infer import infer_batch as infer_batch
from boomdp_jax.inference.informative_wrench import (
    InformationGain as InformationGain,
)
from boomdp_jax.inference.informative_wrench import (
    informative_wrench as informative_wrench,
)
from boomdp_jax.inference.kind_prior import KindPrior as KindPrior
from boomdp_jax.inference.kinds import infer_kinds as infer_kinds
from boomdp_jax.inference.kinds_file import LearntKinds as LearntKinds
from boomdp_jax.inference.kinds_file import load_kinds as load_kinds
from boomdp_jax.inference.kinds_posterior import KindsPosterior as KindsPosterior
from boomdp_jax.inference.laplace_mixture import LaplaceMixture as LaplaceMixture
from boomdp_jax.inference.likelihoods import LIKELIHOODS as LIKELIHOODS
from boomdp_jax.inference.numpyro_model import ObjectModel as ObjectModel
from boomdp_jax.inference.numpyro_model import make_model as make_model
from boomdp_jax.inference.nuts import run_nuts as run_nuts
from boomdp_jax.inference.online import Observed as Observed
from boomdp_jax.inference.online import OnlineBelief as OnlineBelief
from boomdp_jax.inference.online_refit import RefitInfo as RefitInfo
from boomdp_jax.inference.online_refresh import OnlineInfo as OnlineInfo
from boomdp_jax.inference.online_state import BeliefState as BeliefState
from boomdp_jax.inference.plain_metropolis import plain_metropolis as plain_metropolis
from boomdp_jax.inference.plain_problem import plain_problem as plain_problem
from boomdp_jax.inference.posterior import Posterior as Posterior
from boomdp_jax.inference.posterior import load_posterior as load_posterior
from boomdp_jax.inference.predict import predict as predict
from boomdp_jax.inference.structure_kernel import StructureKernel as StructureKernel
from boomdp_jax.inference.sweep import Sweep as Sweep
from boomdp_jax.inference.sweep import begin_sweep as begin_sweep
from boomdp_jax.inference.sweep import infer_sweep as infer_sweep
from boomdp_jax.inference.sweep_failures import SweepError as SweepError
from boomdp_jax.inference.target import StructureTarget as StructureTarget

__all__ = [
    "LIKELIHOODS",
    "METHODS",
    "BeliefState",
    "Identifiability",
    "InformationGain",
    "KindPrior",
    "KindsPosterior",
    "LaplaceMixture",
    "LearntKinds",
    "ObjectModel",
    "Observed",
    "OnlineBelief",
    "OnlineInfo",
    "Posterior",
    "RefitInfo",
    "StructureKernel",
    "StructureTarget",
    "Sweep",
    "SweepError",
    "begin_sweep",
    "identifiability",
    "infer",
    "infer_batch",
    "infer_kinds",
    "infer_sweep",
    "informative_wrench",
    "load_kinds",
    "load_posterior",
    "make_model",
    "plain_metropolis",
    "plain_problem",
    "predict",
    "run_nuts",
    "structure_kernel",
    "without_stops",
]

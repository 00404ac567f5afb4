"""From a history to a posterior over Φ and over which constraints exist."""

from boomdp_jax.inference.doubts.end_stops import without_stops as without_stops
from boomdp_jax.inference.failures import SweepError as SweepError
from boomdp_jax.inference.infer import METHODS as METHODS
from boomdp_jax.inference.infer import infer as infer
from boomdp_jax.inference.infer import infer_batch as infer_batch
from boomdp_jax.inference.kinds.file import LearntKinds as LearntKinds
from boomdp_jax.inference.kinds.file import load_kinds as load_kinds
from boomdp_jax.inference.kinds.infer_kinds import infer_kinds as infer_kinds
from boomdp_jax.inference.kinds.posterior import KindsPosterior as KindsPosterior
from boomdp_jax.inference.kinds.prior import KindPrior as KindPrior
from boomdp_jax.inference.likelihoods.choice import LIKELIHOODS as LIKELIHOODS
from boomdp_jax.inference.likelihoods.target import StructureTarget as StructureTarget
from boomdp_jax.inference.online.belief import Observed as Observed
from boomdp_jax.inference.online.belief import OnlineBelief as OnlineBelief
from boomdp_jax.inference.online.refit import RefitInfo as RefitInfo
from boomdp_jax.inference.online.refresh import OnlineInfo as OnlineInfo
from boomdp_jax.inference.online.state import BeliefState as BeliefState
from boomdp_jax.inference.posteriors.posterior import Posterior as Posterior
from boomdp_jax.inference.posteriors.posterior import load_posterior as load_posterior
from boomdp_jax.inference.posteriors.predict import predict as predict
from boomdp_jax.inference.pushes.identifiability import (
    Identifiability as Identifiability,
)
from boomdp_jax.inference.pushes.identifiability import (
    identifiability as identifiability,
)
from boomdp_jax.inference.pushes.informative_wrench import (
    InformationGain as InformationGain,
)
from boomdp_jax.inference.pushes.informative_wrench import (
    informative_wrench as informative_wrench,
)
from boomdp_jax.inference.samplers.laplace_mixture import (
    LaplaceMixture as LaplaceMixture,
)
from boomdp_jax.inference.samplers.plain_metropolis import (
    plain_metropolis as plain_metropolis,
)
from boomdp_jax.inference.samplers.plain_problem import plain_problem as plain_problem
from boomdp_jax.inference.samplers.structure_kernel import (
    StructureKernel as StructureKernel,
)
from boomdp_jax.inference.sweeps.sweep import Sweep as Sweep
from boomdp_jax.inference.sweeps.sweep import begin_sweep as begin_sweep
from boomdp_jax.inference.sweeps.sweep import infer_sweep as infer_sweep
from boomdp_jax.inference.under_numpyro.fitted_kernel import (
    structure_kernel as structure_kernel,
)
from boomdp_jax.inference.under_numpyro.numpyro_model import ObjectModel as ObjectModel
from boomdp_jax.inference.under_numpyro.numpyro_model import make_model as make_model
from boomdp_jax.inference.under_numpyro.nuts import run_nuts as run_nuts

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

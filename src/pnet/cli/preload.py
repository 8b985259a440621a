"""What every training imports; a process that has done so can be forked for each job."""

import lightning  # noqa: F401
import torch.utils.tensorboard  # noqa: F401

import pnet.cli.build
import pnet.cli.train
import pnet.engine.callbacks
import pnet.engine.tensorboard
import pnet.engine.training  # noqa: F401

"""Policies: learned files, functions and ONNX graphs, scripted gaits.

``load_policy`` and what it returns need numpy only (onnxruntime for ``.onnx`` files); the source
policies of ``function`` and ``scripted`` act inside compiled code and need jax.
"""

from twirl_mjx.policies.learned import (
    NumpyPolicy,
    PolicyFileError,
    PolicyHeader,
    load_policy,
    save_policy,
)

__all__ = ["NumpyPolicy", "PolicyFileError", "PolicyHeader", "load_policy", "save_policy"]

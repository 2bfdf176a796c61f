"""Beliefscope: diagnostics and interpretability for multimodal differentiable filters."""

__version__ = "0.1.0"
__all__ = ["__version__"]

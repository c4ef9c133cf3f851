"""Base class and context of components, for their authors; docs/components.md explains them."""

from zscout.behaviors.components.component import Component, ComponentContext, Stage

__all__ = ["Component", "ComponentContext", "Stage"]

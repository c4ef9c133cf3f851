"""What an author writes a component with; docs/components.md tells how."""

from zscout.behaviors.components.component import Component, ComponentContext, Stage

__all__ = ["Component", "ComponentContext", "Stage"]

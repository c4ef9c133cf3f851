"""For authors of components: import from `zscout.components.component`."""

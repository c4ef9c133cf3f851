"""For authors of components: `zscout.components.component` has what one is written with."""

"""Writers of other projects' layouts: Siléane's and BOP's."""

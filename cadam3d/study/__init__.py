"""Study: a blinded comparison of arms by people, from the page that they see to the analysis of their answers."""

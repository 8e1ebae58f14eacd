"""Study: people compare arms without knowing which is which, on a page that works without a network."""

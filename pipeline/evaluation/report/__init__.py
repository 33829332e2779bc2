"""What a person reads of an evaluation: tables, figures, the page, and what differences mean."""

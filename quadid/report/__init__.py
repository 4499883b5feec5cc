"""Results for people: plain verdicts, and one self-contained HTML page.  Nothing heavy is imported here."""

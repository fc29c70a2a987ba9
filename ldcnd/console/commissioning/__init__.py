"""The commissioning page of the console: scan, checklist and tuning for a person in front of a browser.

`ldcnd console --commission` serves it. It brings the console together with commissioning, tuning and the scan of a
port, none of which knows of the others. Start with `routes`; `page_person` is how a page answers.
"""

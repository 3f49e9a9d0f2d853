"""What users may set: settings of the stages, a robot's camera, the YAML files of surveys, estates and drives.

``vinemap config`` prints all of it (`template.py`). A setting of a stage goes into `settings.py`.
"""

"""Draw a mesh in Blender, with a Python that has bpy: in_blender.py FILE PICTURE EYE FOV_DEG SIZE."""

import json
import math
import sys

import bpy
from mathutils import Vector

path, target, eye, fov_deg, size = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
importers = {"glb": bpy.ops.import_scene.gltf, "obj": bpy.ops.wm.obj_import, "stl": bpy.ops.wm.stl_import}
importers[path.rpartition(".")[2]](filepath=path)
scene = bpy.context.scene

camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.data.sensor_fit = "VERTICAL"
camera.data.angle = math.radians(float(fov_deg))
camera.location = json.loads(eye)
camera.rotation_euler = (-Vector(camera.location)).to_track_quat("-Z", "Y").to_euler()
scene.collection.objects.link(camera)
scene.camera = camera

scene.world = bpy.data.worlds.new("white")
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
scene.render.engine = "CYCLES"
scene.cycles.samples = 16
scene.view_settings.view_transform = "Standard"
scene.render.resolution_x = scene.render.resolution_y = int(size)
scene.render.filepath = target
bpy.ops.render.render(write_still=True)

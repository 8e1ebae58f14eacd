"""The words of the grammar: colours, patterns, sizes, numbers and relations. Objects are in objects.py.

At the end are the words that the grammar does not know but for which it can suggest others.
"""

# Albedo in [0, 1]. The colours are saturated but never 0 or 1, so that shading and over-saturation stay
# visible.
COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.86, 0.12, 0.12),
    "orange": (0.95, 0.50, 0.10),
    "yellow": (0.95, 0.82, 0.14),
    "green": (0.16, 0.62, 0.22),
    "cyan": (0.16, 0.76, 0.80),
    "blue": (0.14, 0.30, 0.84),
    "purple": (0.52, 0.20, 0.72),
    "pink": (0.95, 0.48, 0.68),
    "white": (0.95, 0.95, 0.95),
    "grey": (0.52, 0.53, 0.55),
    "black": (0.10, 0.10, 0.11),
    "brown": (0.46, 0.28, 0.15),
    "beige": (0.90, 0.82, 0.66),
    "cream": (0.96, 0.92, 0.80),
    "gold": (0.85, 0.65, 0.18),
    "silver": (0.75, 0.77, 0.80),
    "turquoise": (0.20, 0.72, 0.66),
    "lime": (0.60, 0.86, 0.20),
    "olive": (0.46, 0.48, 0.16),
    "maroon": (0.46, 0.08, 0.12),
    "navy": (0.08, 0.12, 0.40),
    "violet": (0.48, 0.28, 0.86),
    "magenta": (0.86, 0.16, 0.62),
    "teal": (0.06, 0.46, 0.48),
    "charcoal": (0.22, 0.23, 0.25),
}
COLOUR_ALIASES = {"gray": "grey", "golden": "gold", "tan": "beige", "crimson": "maroon", "aqua": "cyan"}

# The equally likely colours of an object without a given colour; each gives one mode of the mixture.
OPEN_PALETTE = ("red", "orange", "yellow", "green", "cyan", "blue", "purple", "pink")

PLAIN = "plain"
PATTERNS = {
    "plain": PLAIN,
    "striped": "striped",
    "stripy": "striped",
    "banded": "striped",
    "checkered": "checkered",
    "chequered": "checkered",
    "checked": "checkered",
    "spotted": "spotted",
    "dotted": "spotted",
    "spotty": "spotted",
}

# Factors of the natural size of an object. They are visible only if a scene has several objects.
SIZES = {"tiny": 0.4, "small": 0.65, "little": 0.65, "medium": 1.0, "large": 1.5, "big": 1.5, "huge": 2.2}
# Factors along x, y and z.
STRETCHES = {
    "tall": (1.0, 1.0, 1.5),
    "short": (1.0, 1.0, 0.65),
    "flat": (1.0, 1.0, 0.45),
    "wide": (1.0, 1.5, 1.0),
    "long": (1.5, 1.0, 1.0),
    "thin": (0.65, 0.65, 1.0),
}
NUMBERS = {"one": 1, "two": 2, "three": 3, "four": 4, "five": 5}

# Longest first, since the first match is taken; "of" is a filler.
RELATIONS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("on", "top"), "on"),
    (("in", "front"), "in front of"),
    (("next", "to"), "next to"),
    (("beside",), "next to"),
    (("near",), "next to"),
    (("on",), "on"),
    (("atop",), "on"),
    (("above",), "above"),
    (("over",), "above"),
    (("under",), "under"),
    (("below",), "under"),
    (("beneath",), "under"),
    (("underneath",), "under"),
    (("behind",), "behind"),
    (("between",), "between"),
    (("and",), "next to"),
)
ARTICLES = frozenset({"a", "an", "the", "some"})
# Words that are common in prompts and do not describe the scene, as in "a 3d model of a ...".
FILLERS = frozenset({"photo", "picture", "image", "render", "rendering", "model", "3d", "of"})

# Words that the grammar does not know, and the known words that an error message suggests instead. An entry
# is a common noun of prompts for text-to-3D models with an object of similar shape or use, a word for a
# relation, or a frequent word of another language. Singular; plurals are derived.
NEAR_WORDS: dict[str, str] = {
    "robot": (
        "animal ant astronaut bear bee bird boy bulldog bunny butterfly cat chicken child corgi cow "
        "creature crocodile deer dinosaur dog dragon eagle elephant fox frog giraffe girl goat gorilla "
        "hamster horse human kitten knight lego lion lizard man monkey monster mouse octopus owl panda "
        "parrot peacock people person pig pony puppy rabbit raccoon rat sheep snake soldier spider "
        "squirrel statue tiger toy trex turtle tyrannosaurus unicorn warrior wizard wolf woman zebra "
        "zombie hund katze chien gato roboter"
    ),
    "snowman": "baby bust doll duck figure figurine gnome penguin santa teddy buddha",
    "car": (
        "ambulance bicycle bike bulldozer bus jeep locomotive lorry motorbike motorcycle scooter tank "
        "taxi tractor train tram truck van vehicle wagon auto voiture coche carro macchina"
    ),
    "boat": "canoe ferry galleon gondola kayak raft submarine vessel yacht schiff bateau barco",
    "rocket": (
        "airplane aeroplane aircraft helicopter jet missile plane shuttle spacecraft starship zeppelin"
    ),
    "house": (
        "apartment barn building bungalow cabin church garage hut igloo mansion office pavilion school "
        "shed shrine temple villa haus maison casa"
    ),
    "castle": "chateau citadel fort fortress opera palace burg schloss castillo castello",
    "lighthouse": "belfry chimney minaret obelisk skyscraper steeple leuchtturm phare faro",
    "windmill": "fan propeller turbine moulin molino",
    "chair": "armchair bench couch seat sofa throne stuhl chaise silla sedia",
    "table": "bed counter shelf stand tisch mesa tavolo",
    "mug": (
        "basket beaker bottle bowl bucket glass goblet jar jug kettle pitcher pot teacup teapot vase "
        "tasse taza"
    ),
    "lamp": "bulb chandelier lantern streetlight lampe",
    "candle": "torch kerze bougie vela",
    "hammer": (
        "axe brush drill fork gun guitar key knife racket saw screwdriver shovel spoon sword tool violin "
        "wrench"
    ),
    "cake": (
        "bread burger cheesecake cupcake food hamburger lasagna loaf muffin pancake pie pizza pudding "
        "sandwich tart kuchen gateau"
    ),
    "donut": "bagel pretzel tire tyre wheel",
    "icecream": "gelato popsicle sundae",
    "mushroom": "champignon fungus jellyfish umbrella parasol pilz seta",
    "flower": "bouquet daisy lily orchid plant rose sunflower tulip blume fleur flor fiore",
    "tree": "bonsai bush forest oak palm shrub baum arbre arbol albero",
    "pine": "spruce christmas conifer",
    "cactus": "aloe succulent kaktus",
    "planet": "earth jupiter mars moon saturn world",
    "sphere": (
        "apple balloon baseball basketball bead berry bomb bubble cannonball football fruit head marble "
        "melon pearl peach pumpkin skull soccer strawberry sun tomato watermelon kugel boule bola palla "
        "esfera"
    ),
    "cube": "wurfel cubo rubik",
    "box": (
        "book cabinet cage camera chest computer console crate cupboard drawer fridge laptop phone piano "
        "radio refrigerator suitcase television treehouse tv typewriter wardrobe caja boite"
    ),
    "cylinder": "barrel battery can column drum log pillar tin zylinder cilindro",
    "capsule": "banana carrot cucumber hotdog pickle sausage",
    "cone": "funnel hat horn kegel cono",
    "pyramid": "hill mountain tent volcano pyramide piramide",
    "disc": "cookie dish medal pancakes shield turntable wafer",
    "ring": "anillo anneau band bracelet crown necklace wreath",
    "ellipsoid": "avocado fish lemon pear pineapple potato seed shark stone rock whale",
    "octahedron": "crystal emerald jewel ruby sapphire",
    "arch": "bridge gate rainbow",
    "star": "asterisk snowflake starfish stern estrella etoile stella",
    "red": "rot rote roten roter rotes rouge rojo roja rosso rossa scarlet",
    "blue": "blau blaue blauer blaues bleu bleue azul azure",
    "green": "grun grune gruner grunes vert verte verde emeralds",
    "yellow": "gelb gelbe gelber gelbes jaune amarillo giallo",
    "white": "weiss weisse weisser weisses blanc blanche blanco blanca bianco ivory",
    "black": "schwarz schwarze schwarzer schwarzes noir noire negro nero",
    "purple": "lila lavender",
    "brown": "bronze copper wooden",
    "silver": "chrome metallic steel",
    "gold": "brass",
    "striped": "stripe",
    "spotted": "dot polka speckled",
    "small": "klein kleine kleiner kleines miniature petit petite pequeno piccolo",
    "large": "giant gigantic enormous gross grosse grosser grosses grand grande massive",
    "long": "elongated stretched",
    "two": "2 both couple pair zwei deux dos due",
    "three": "3 few many several drei trois tres tre",
    "four": "4 vier quatre cuatro quattro",
    "five": "5 6 7 8 9 10 12 six seven eight nine ten dozen hundred funf cinq cinco cinque",
    "one": "1 single",
    "on": "riding upon onto auf sur sobre",
    "under": "wearing unter sous",
    "next to": "against alongside around by inside holding neben with",
    "behind": "hinter derriere detras",
    "and": "und et y plus",
}
# Frequent words of prompts that describe the quality of a picture or a material, and words of other languages
# without content. The nearest prompt leaves them out.
_IGNORED = """
highly detailed detail details photorealistic realistic dslr 8k 4k hd uhd hdr high resolution
quality best masterpiece award winning cinematic studio lighting trending artstation unreal engine
octane blender beautiful cute pretty nice ultra very super extremely sharp focus side back view
angle shot zoomed out zoom isolated background please style made from at as like dressed sitting
standing planted piled is are that this it its for ein eine einen einem einer eines der die das dem
den un une le la les el los las il lo uno una de des du del
"""
IGNORED_WORDS = frozenset(_IGNORED.split())

# For each object of the world, others of similar shape, the most similar first. The message of a model that
# has learned only a part of this world names the first one that the model knows.
SIMILAR_NOUNS: dict[str, str] = {
    "sphere": "ellipsoid planet snowman capsule torus",
    "cube": "box house prism pyramid cylinder",
    "box": "cube house prism cylinder",
    "torus": "donut ring tube sphere",
    "cylinder": "tube capsule disc candle cake cone",
    "cone": "pyramid icecream pine cylinder",
    "capsule": "ellipsoid cylinder sphere",
    "pyramid": "tetrahedron cone octahedron cube",
    "disc": "cake ring cylinder torus",
    "ring": "torus donut tube disc",
    "ellipsoid": "sphere capsule planet",
    "tetrahedron": "pyramid octahedron cone star",
    "octahedron": "tetrahedron pyramid star cube",
    "prism": "house pyramid box cube",
    "tube": "cylinder ring torus",
    "star": "flower octahedron tetrahedron",
    "arch": "ring house torus",
    "lighthouse": "windmill candle rocket castle cylinder",
    "snowman": "robot sphere capsule",
    "chair": "table box cube",
    "table": "chair box cube",
    "mug": "cylinder tube cake",
    "rocket": "lighthouse cone capsule cylinder",
    "house": "castle prism box cube",
    "tree": "pine mushroom flower cactus lamp cone",
    "pine": "tree cone cactus pyramid",
    "hammer": "lamp mushroom table cylinder",
    "mushroom": "lamp tree icecream flower cone",
    "car": "boat box robot cube",
    "robot": "snowman rocket house cube",
    "lamp": "mushroom candle tree cone",
    "boat": "car ellipsoid box",
    "castle": "house lighthouse cube",
    "cactus": "pine tree capsule cylinder",
    "flower": "star mushroom tree lamp",
    "windmill": "lighthouse house star cylinder",
    "cake": "disc cylinder mug",
    "icecream": "cone mushroom tree",
    "candle": "lighthouse cylinder lamp capsule",
    "planet": "sphere ring donut",
    "donut": "torus ring disc",
}

from lamp import Lamp

from zscout.testing import MemoryFleet, in_virtual_time, until


@in_virtual_time
async def test_the_lamp_is_set_and_goes_out(tmp_path):
    file = tmp_path / "brightness"
    file.touch()
    async with MemoryFleet({"lamp/desk": Lamp.configured(Lamp.Options(path=str(file)))}) as fleet:
        async with fleet.hold("blink", {"lamp/desk": {"level": 200}}) as held:
            await held.command("lamp/desk", {"name": "set", "level": 50})
            assert file.read_text() == "50\n"
        await until(lambda: file.read_text() == "0\n")
